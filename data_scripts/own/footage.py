"""The frames of an own camera: a folder of images, whose names say which are neighbours in time, or a video."""

import itertools
from collections.abc import Container, Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dualdepth.data.frames import IMAGES, Video, is_image, media, name_parts
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError, note
from dualdepth.files import file_digest, short_digest


class FootageFrame(NamedTuple):
    """One frame of a footage."""

    number: int  # its place in time; neighbours differ by one, and a number that is missing is a gap
    image: np.ndarray  # (H, W, 3) uint8, RGB
    file: Path | None  # its image file; None for a video's


class Footage:
    """A folder of images, in natural order, or a video; can be gone through more than once. An `InputError` says that
    there is none, that it holds no images, or that it is no video that can be read."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.files: dict[int, Path] | None = _numbered_images(self.path) if self.path.is_dir() else None
        if self.files is None and (not self.path.is_file() or is_image(self.path)):
            raise InputError(f"{self.path}: there is no such video and no folder of frames; give one of these")
        video = Video(self.path) if self.files is None else None
        self.length = (video.announced or 0) if video else len(self.files)
        """Frames; of a video as its header says, which may be wrong."""
        if video:
            video.close()

    def stills(self, wanted: Container[int] | None = None) -> Iterator[FootageFrame]:
        """The frames in order, or those whose numbers are wanted. An `InputError` says that one cannot be read or is not of the first one's
        size, or that a video ends before its announced end."""
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
    """Image files by their place in time: the last number of the name, in usual steps; where it does not rise, places in natural order.
    Numbers from nearly 0 to nearly 9999 (or 999, …), with a gap of more than half of that, are of a counter that rolled over."""
    there, said = media(folder.iterdir(), folder, videos=False), ""
    one: dict[str, Path] = {}
    for file in there:
        stem = file.stem if file.suffix.lower() in IMAGES else file.name
        one[stem] = min(one.get(stem, file), file, key=lambda path: path.suffix.lower())  # a PNG beside a JPEG may be depth
    files = list(one.values())
    if len(files) < len(there):
        note(f"{folder}: {len(there) - len(files)} of {len(there)} images are left out, since others have their names but for the ending")
    numbers = [(parts[-2:-1] or [0])[0] for parts in name_parts(Path(file.name) for file in files).values()]
    times = [numbers, *([_clock(number, unit) for number in numbers] for unit in (1, 10**3, 10**6))]
    # the most even ones, of numbers or of clock times; no array: nanoseconds may exceed 64 bits
    steps = max(([b - a for a, b in itertools.pairwise(t)] for t in times if None not in t), key=lambda s: sum(_neighbours(s)))
    if min(steps, default=1) <= 0:
        steps, said = [1] * len(steps), "the names do not say the order in time; natural order is taken"
    elif steps and max(steps) > (turn := max(1000, 10 ** len(str(numbers[-1])))) / 2 and numbers[0] + turn - numbers[-1] < turn / 100:
        at, over, said = steps.index(max(steps)), turn - numbers[-1] + max(0, numbers[0] - 1), "the numbers roll over"  # cameras have no 0
        files, steps = files[at + 1 :] + files[: at + 1], [*steps[at + 1 :], over, *steps[:at]]
    if said:
        note(f"{folder}: {said}, from {files[0].name} to {files[-1].name}")
    usual, places = float(np.median(steps or [1])), [0]
    for step, near in zip(steps, _neighbours(steps)):
        places.append(places[-1] + (1 if near else max(2, round(step / usual))))
    return dict(zip(places, files))


def _neighbours(steps: list[int]) -> list[bool]:
    """Which steps lead from a frame to its neighbour; names may be times in nanoseconds, whose steps are never quite the same."""
    usual = float(np.median(steps or [1]))
    return [0.5 * usual < step < 1.5 * usual for step in steps]


def _clock(number: int, unit: int) -> int | None:
    """The time of `20261130125959`, in `unit`ths of a second, where digits for these follow; None where it is none, or before one o'clock
    of no day, as of small counters."""
    rest, part = divmod(number, unit)
    rest, seconds = divmod(rest, 100)
    rest, minutes = divmod(rest, 100)
    days, hours = divmod(rest, 100)
    return (((days * 24 + hours) * 60 + minutes) * 60 + seconds) * unit + part if rest and max(hours + 36, minutes, seconds) < 60 else None
