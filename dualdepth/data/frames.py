"""Frames of any camera: a folder of images or a video file, in their order; and how they are resampled."""

import itertools
import math
import os
import re
from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.files import file_digest, short_digest

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # else FFmpeg tells of a damaged file in its own words as well
DEFAULT_RATE = 25.0  # Frames a second where the file does not say.


def resample(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resample (H, W, C) to `size` (height, width): area averages where it shrinks, bilinear where it grows."""
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


class Video:
    """A video that is read once from its beginning; frames are turned as the file says, (H, W, 3) uint8 RGB.

    Raises:
        InputError: it cannot be opened or has no frames.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # a file that cannot be opened is this class's to tell
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(level)
        count, rate = self._capture.get(cv2.CAP_PROP_FRAME_COUNT), self._capture.get(cv2.CAP_PROP_FPS)
        self.announced = int(count) if 0 < count < 1e9 else None
        """Frames that the file says it has; None where it does not say."""
        self.rate = rate if math.isfinite(rate) and 0 < rate <= 1000 else DEFAULT_RATE
        """Frames a second."""
        self.passed = 0
        """Frames that were there so far."""
        self.convert = f"ffmpeg -i {self.path.name} -crf 17 video.mp4"
        """What a user may do about a damaged one."""
        there, self._first = self._capture.read()
        if not there:
            self.close()
            raise InputError(f"{path}: no video that can be decoded, or one without frames; copy it again, or convert it: {self.convert}")

    def frames(self, wanted: Container[int] | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Number, from 0, and picture of all frames that can be read, or of those whose numbers are wanted; others are not decoded."""
        frame = self._first
        try:
            while True:
                if wanted is None or self.passed in wanted:
                    there, frame = (True, frame) if self.passed == 0 else self._capture.retrieve()
                    if not there:
                        return
                    yield self.passed, cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
                self.passed += 1
                if not self._capture.grab():
                    return
        finally:
            self.close()

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first frame; in rare files later frames differ."""
        return self._first.shape[:2]

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()

    @property
    def missing(self) -> str | None:
        """A word on a video that ended early, once it was read; None where all were there, or nearly so: some formats only estimate."""
        if self.announced and self.passed < self.announced - max(2, self.announced // 50):
            return f"ends early: {self.passed} of {self.announced} announced frames could be read"
        return None


class FootageFrame(NamedTuple):
    """One frame of a footage."""

    number: int  # its place in time; neighbours differ by one, and a number that is missing is a gap
    image: np.ndarray  # (H, W, 3) uint8, RGB
    file: Path | None  # its image file; None for a video's


class Footage:
    """A folder of images, ordered by the last number in their names, or a video; can be gone through more than once.

    Raises:
        InputError: there is no such file or folder, it holds no images, or it is no video that can be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.files: dict[int, Path] | None = _numbered_images(self.path) if self.path.is_dir() else None
        if self.files is None and (not self.path.is_file() or self.path.suffix.lower() in IMAGES):
            raise InputError(f"{self.path}: there is no such video and no folder of frames; give one of these")
        video = Video(self.path) if self.files is None else None
        self.length = (video.announced or 0) if video else len(self.files)
        """Frames; of a video as its header says, which may be wrong."""
        if video:
            video.close()

    def stills(self, wanted: Container[int] | None = None) -> Iterator[FootageFrame]:
        """The frames in order, or those whose numbers are wanted.

        Raises:
            InputError: a frame cannot be read, or is of another size than the first; a video ends before its announced end.
        """
        video = Video(self.path) if self.files is None else None
        if video:
            stills = (FootageFrame(number, image, None) for number, image in video.frames(wanted))
        else:
            files = ((number, file) for number, file in self.files.items() if wanted is None or number in wanted)
            stills = (FootageFrame(number, read_image(file), file) for number, file in files)
        first: tuple[int, ...] = ()
        for still in stills:
            size = still.image.shape[1::-1]
            first = first or size
            if size != first:
                sizes = f"frame {still.number} has {size[0]}×{size[1]} pixels, the first one {first[0]}×{first[1]}"
                raise InputError(f"{still.file or self.path}: {sizes}; give frames of one size, others in a data set of their own")
            yield still
        if video and video.missing:
            raise InputError(f"{self.path}: {video.missing}; copy it again, or keep what is there: {video.convert}")

    def digest(self) -> str:
        """Of the names and bytes of all it is read from."""
        files = self.files.values() if self.files is not None else [self.path]
        return short_digest(*(f"{file.name} {file_digest(file)}" for file in files))


def _numbered_images(folder: Path) -> dict[int, Path]:
    """Image files by their place in time: the last number of the name, in usual steps; without numbers in the order of names."""
    files = sorted(path for path in folder.iterdir() if path.suffix.lower() in IMAGES and not path.name.startswith("."))
    if not files:
        raise InputError(f"{folder}: holds no images ({', '.join(IMAGES)}); give the folder that the frames lie in")
    numbers = [int((re.findall(r"\d{1,20}", path.stem) or [-1])[-1]) for path in files]
    if len(set(numbers)) < len(files):
        return dict(enumerate(files))
    numbers, files = zip(*sorted(zip(numbers, files)))
    steps = [after - before for before, after in itertools.pairwise(numbers)]  # no array: nanoseconds may exceed 64 bits
    usual = float(np.median(steps)) if steps else 1.0
    places = [0]
    for step in steps:  # names may be times in nanoseconds, whose steps are never quite the same
        places.append(places[-1] + (1 if 0.5 * usual < step < 1.5 * usual else max(2, round(step / usual))))
    return dict(zip(places, files))
