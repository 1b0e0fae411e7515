"""Frames of any camera: files that are images or videos, a folder of images or a video, in their order; and how they are resampled."""

import contextlib
import itertools
import os
import re
import shlex
from collections.abc import Container, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image

from dualdepth.data.kitti import HEIF, read_image
from dualdepth.errors import InputError, note
from dualdepth.files import file_digest, short_digest

IMAGES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".ppm", ".pgm")
VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv", ".ts", ".mts", ".m2ts", ".3gp", ".flv", ".ogv", ".vob")
STREAMS = (".mjpeg", ".mjpg")  # Photos, one behind the other.
FILM = re.compile(rb"\x1aE\xdf\xa3|RIFF....AVI |FLV|(?:....)?G@|....ftyp|OggS|0&\xb2u", re.DOTALL)  # Of films.
TEXTS = (".txt", ".json", ".csv", ".xml", ".xmp", ".yaml", ".yml", ".md", ".log", ".srt", ".gpx")  # They go with images and videos.
LAST_NUMBER = re.compile(r"(\d+)(?:\.(\d+))?(?=[^\d/\\]*$)")
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # else FFmpeg tells of a damaged file in its own words as well
DEFAULT_RATE = 25.0  # Frames a second where the file does not say.


def resample(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resample (H, W, C) to `size` (height, width): area averages where it shrinks, bilinear where it grows."""
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def is_image(path: Path) -> bool:
    """Whether a file is one image, no animation and no film: by its first bytes, or where these say nothing by its ending."""
    head = b""
    with contextlib.suppress(OSError), path.open("rb") as file:
        head = file.read(12)
        with contextlib.suppress(Exception), PIL.Image.open(file) as image:  # Pillow's readers have one for each damage
            moves = image.format == "GIF" and image.is_animated and "duration" in image.info  # FFmpeg stops where frames have no time
            return not (moves or image.format in ("MPEG", "FLI") or path.suffix.lower() in STREAMS)
    return head[4:] in HEIF or (path.suffix.lower() in IMAGES and not FILM.match(head))


def media(paths: Iterable[Path], where: object, videos: bool = True) -> list[Path]:
    """Images, and `videos` if wanted, among files of a place, in natural order; an `InputError` if there are none. A note tells of others,
    but for texts and hidden files, and of a folder's own folders."""
    parts, what, usable = _parts(paths), "images or videos" if videos else "images", []
    inside = [path for path in parts if path.is_dir() and path.name[:1] != "." and not (path / "predictions.json").exists()]
    below = len(inside) if Path(str(where)).is_dir() else 0
    folders = f"folders in it ({below}) are not looked into; " + (f"'{where}/**/*' stands for all" if videos else "give one of them")
    shown = [p for p in sorted(parts, key=lambda p: (parts[p], p)) if p.name[:1] != "." and p.suffix.lower() not in TEXTS]
    files = [path for path in shown if path.is_file() or not path.exists()]  # with links that lead nowhere, of which a user is told
    for path in files:
        with contextlib.suppress(InputError):
            if path.suffix.lower() in IMAGES + VIDEOS * videos or is_image(path) or (videos and Video(path).close() is None):
                usable.append(path)
    endings = ", ".join(sorted({path.suffix.lower() or "no ending" for path in {*files} - {*usable}}))
    if not usable:
        other = f"give the folder that they lie in, not {endings or 'an empty one'}"
        raise InputError(f"{where}: no {what} there; {folders if below else other}")
    if below:
        note(f"{where}: {folders}")
    if endings:
        note(f"{where}: {len(files) - len(usable)} of {len(files)} files are left out, since they are no {what} ({endings})")
    return usable


def _parts(paths: Iterable[Path]) -> dict[Path, list[str | int]]:
    """Texts and numbers of each name, in turn. `1305031102.1753` at the end is one number, in units of the finest fraction, but not
    counters, `2.9`, `2.10`. Zeros tell: fractions begin with one now and then, and are of one length or end with none. What follows
    all times, `_cam0`, is left out; a name may begin with a minus."""
    names = {path: os.path.splitext(path)[0] for path in paths}
    tails = {(re.search(r"\d\.\d+([^\d./\\][^/\\]*)$", name) or [0, ""])[1] for name in names.values()}
    names = {path: name.removesuffix(*tails) for path, name in names.items()} if len(tails) == 1 else names
    last = [(name[: match.start()], *match.groups()) for name in names.values() if (match := LAST_NUMBER.search(name))]
    found, texts = [(whole, fraction) for _, whole, fraction in last if fraction], {text for text, _, fraction in last if fraction}
    lengths = {len(fraction) for _, fraction in found}
    begins, ends = (any(len(fraction) > 1 and fraction[place] == "0" for _, fraction in found) for place in (0, -1))
    decimal = begins or len(lengths) == 1 or (lengths and not ends and len({whole for text, whole, _ in last if text in texts}) > 1)
    if len(lengths) > 1 and not (begins or ends):
        note(f"{'.'.join(min(found))}, of a name, may be one number or two; {'one' if decimal else 'two'} is assumed for the order")
    names = {p: LAST_NUMBER.sub(lambda m: m[1] + (m[2] or "").ljust(max(lengths), "0"), n) if decimal else n for p, n in names.items()}
    return {path: [int(t) if k % 2 else t for k, t in enumerate(re.split(r"((?:(?<![^/\\])-)?\d+)", name))] for path, name in names.items()}


class Video:
    """A video that is read once from its beginning; frames are turned as the file says, (H, W, 3) uint8 RGB.
    An `InputError` says that it cannot be opened or has no frames."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        whole = self.path.absolute()  # What is before a colon may be a protocol; and OpenCV crashes over str that are no UTF-8.
        self._capture = cv2.VideoCapture(os.fsencode(whole), cv2.CAP_FFMPEG)
        count, rate = self._capture.get(cv2.CAP_PROP_FRAME_COUNT), self._capture.get(cv2.CAP_PROP_FPS)
        self.announced = int(count) if 0 < count < 1e9 else None
        """Frames that the file says it has; None where it does not say."""
        self.rate = rate if 1e-4 <= rate <= 65535 else DEFAULT_RATE
        """Frames a second."""
        self.passed = 0
        """Frames that were there so far."""
        self.convert = shlex.join(["ffmpeg", "-i", str(whole), "-crf", "17", str(whole.with_suffix(".converted.mp4"))])
        """What a user may do about a damaged one."""
        there, self._first = self._capture.read()
        codec = int(self._capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True).strip(b"\0").decode("ascii", "ignore")
        if not there or codec == "ansi":  # of a text, which FFmpeg draws
            self.close()
            empty = self.path.is_file() and not self.path.stat().st_size
            what = f"no video that can be decoded{f' (codec {codec})' * codec.isalnum()}; copy it again or convert it: {self.convert}"
            raise InputError(f"{path}: {'empty; copy it again' if empty else what}")
        if rate != self.rate:
            note(f"{path}: says that it has {rate:g} frames a second; {self.rate:g} are taken")

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
        with self.path.open("rb") as file:
            if file.read(4) == b"GIF8" and b"\0;" not in file.read().rstrip(b"\0")[-16:]:  # it announces what is there
                return f"ends early: {self.passed} frames could be read, and the file has no end"
        return None


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
    numbers = [(parts[-2:-1] or [0])[0] for parts in _parts(Path(file.name) for file in files).values()]
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
