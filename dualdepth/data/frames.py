"""Frames of any camera: files that are images or videos, a folder of images or a video, in their order; and how they are resampled."""

import contextlib
import os
import re
import shlex
from collections.abc import Container, Iterable, Iterator
from pathlib import Path

import cv2
import numpy as np
import PIL.Image

from dualdepth.data.kitti import HEIF
from dualdepth.errors import InputError, note

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
    parts, what, usable = name_parts(paths), "images or videos" if videos else "images", []
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


def name_parts(paths: Iterable[Path]) -> dict[Path, list[str | int]]:
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
