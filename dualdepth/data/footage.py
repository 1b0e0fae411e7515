"""Frames of a user's own camera, in their order: a folder of images or a video file."""

import hashlib
import itertools
import re
from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dualdepth.data.kitti import read_image
from dualdepth.data.video import Video
from dualdepth.errors import InputError

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")


class Still(NamedTuple):
    """One frame of a footage."""

    number: int
    """Its place in time; neighbours differ by one, and a number that is missing is a gap."""
    image: np.ndarray
    """(H, W, 3) uint8, RGB."""
    file: Path | None
    """Its image file; None for a video's."""


class Footage:
    """A folder of images, ordered by the last number in their names, or a video; can be gone through more than once.

    Raises:
        InputError: there is no such file or folder, it holds no images, or it is no video that can be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.files: dict[int, Path] | None = _numbered_images(self.path) if self.path.is_dir() else None
        if self.files is not None:
            self.length = len(self.files)
        else:
            video = self._open()
            self.length = video.announced or 0
            """Frames; of a video as its header says, which may be wrong."""
            video.close()

    def _open(self) -> Video:
        if not self.path.is_file():
            raise InputError(f"{self.path}: there is no such file or folder; give a video, or a folder of frames")
        if self.path.suffix.lower() in IMAGES:
            raise InputError(f"{self.path}: is a single image; give the folder of frames, or a video")
        return Video(self.path)

    def stills(self, wanted: Container[int] | None = None) -> Iterator[Still]:
        """The frames in order, or those whose numbers are wanted.

        Raises:
            InputError: a frame cannot be read, or is of another size than the first; a video ends before its announced end.
        """
        first: tuple[int, ...] = ()
        for still in self._images(wanted) if self.files is not None else self._of_video(wanted):
            first = first or still.image.shape
            if still.image.shape != first:
                raise InputError(
                    f"{still.file or self.path}: frame {still.number} has {_size(still.image.shape)} pixels, the first one"
                    f" {_size(first)}; give frames of one camera and one size, others in a data set of their own"
                )
            yield still

    def _images(self, wanted: Container[int] | None) -> Iterator[Still]:
        for number, file in (self.files or {}).items():
            if wanted is None or number in wanted:
                yield Still(number, read_image(file), file)

    def _of_video(self, wanted: Container[int] | None) -> Iterator[Still]:
        video = self._open()
        for number, image in video.frames(wanted):
            yield Still(number, image, None)
        if video.missing:
            raise InputError(
                f"{self.path}: {video.missing}; copy it again, or keep what is there: ffmpeg -i {self.path.name} -crf 17 video.mp4"
            )

    def digest(self) -> str:
        """sha256 of the names and bytes of all it is read from."""
        total = hashlib.sha256()
        for file in self.files.values() if self.files is not None else [self.path]:
            with file.open("rb") as stream:
                total.update(f"{file.name} {hashlib.file_digest(stream, 'sha256').hexdigest()}\n".encode())
        return total.hexdigest()


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}×{shape[0]}"


def _numbered_images(folder: Path) -> dict[int, Path]:
    """Image files by their place in time: the last number of the name, in usual steps; without numbers in the order of names."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES and not path.name.startswith("."))
    if not files:
        raise InputError(f"{folder}: holds no images ({', '.join(IMAGES)}); give the folder that the frames lie in")
    found = [re.findall(r"\d{1,20}", path.stem) for path in files]
    numbers = [int(digits[-1]) if digits else -1 for digits in found]
    if len(set(numbers)) < len(files):
        return dict(enumerate(files))
    ordered = sorted(zip(numbers, files))
    steps = [after - before for (before, _), (after, _) in itertools.pairwise(ordered)]
    usual = float(np.median(steps)) if steps else 1.0
    places = [0]
    for step in steps:  # names may be times in nanoseconds, whose steps are never quite the same
        places.append(places[-1] + (1 if 0.5 * usual < step < 1.5 * usual else max(2, round(step / usual))))
    return {place: file for place, (_, file) in zip(places, ordered)}
