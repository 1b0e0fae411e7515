"""What is written of images and their depth: 16-bit PNG, colours, array, point cloud, video. Each file is whole or absent."""

import math
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image
import PIL.PngImagePlugin

from dualdepth.errors import InputError
from dualdepth.files import atomic_path
from dualdepth.inference.pictures import Range, picture

PNG_FACTOR = 256
"""A PNG's value / 256 is the depth, as in KITTI's depth maps."""
SUFFIXES = {"depth": ".depth.png", "colour": ".colour.png", "side": ".side.png", "npy": ".depth.npy", "ply": ".ply"}
"""Endings of an image's results, by kind."""
COLOURS = ("red", "green", "blue")
SIDE_VIDEO = ".side.mp4"
ENDINGS = (*SUFFIXES.values(), SIDE_VIDEO)
CODEC = "mp4v"
"""MPEG-4 in MP4, which every OpenCV wheel writes."""
WIDEST = 3840
"""Pixels; wider side-by-side frames are shrunk, since players refuse them."""
KITTI_FIELD_OF_VIEW = 2 * math.degrees(math.atan(1242 / 2 / 721.5377))
"""Degrees, horizontal, of KITTI's colour cameras (81.4); the default, since profiles `sample` and `paper` learn from such images."""


class Camera(NamedTuple):
    """How intrinsics are found for an image; the first that is not None counts."""

    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy in pixels of the image; pixel (0, 0) is the centre of the first pixel."""
    focal: float | None = None
    """fx = fy in pixels of the image, with the principal point in its middle."""
    field_of_view: float = KITTI_FIELD_OF_VIEW
    """Degrees, horizontal."""

    def check(self) -> "Camera":
        """This camera.

        Raises:
            InputError: a number is not finite, a focal length not positive, or the field of view not between 0 and 180 degrees.
        """
        if not 0 < self.field_of_view < 180:
            raise InputError(f"field of view {self.field_of_view}: must be between 0 and 180 degrees")
        numbers = self.of((1, 1))
        if not (all(map(math.isfinite, numbers)) and min(numbers[:2]) > 0):
            raise InputError(f"intrinsics {list(numbers)}: focal lengths must be positive and all numbers finite")
        return self

    def of(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of an image of `size` (height, width)."""
        if self.intrinsics:
            return self.intrinsics
        height, width = size
        focal = width / 2 / math.tan(math.radians(self.field_of_view) / 2) if self.focal is None else self.focal
        return focal, focal, (width - 1) / 2, (height - 1) / 2

    def __str__(self) -> str:
        if self.intrinsics:
            return "fx {} fy {} cx {} cy {} as given".format(*self.intrinsics)
        if self.focal:
            return f"focal length {self.focal} pixels as given, principal point in the middle"
        by = "by default, as KITTI's" if self.field_of_view == KITTI_FIELD_OF_VIEW else "as given"
        return f"horizontal field of view {self.field_of_view:.1f} degrees {by}, principal point in the middle"


class Style(NamedTuple):
    """What is said and assumed in results."""

    about: str
    """What the network learned from."""
    scale: float = 1.0
    """What relative depth is multiplied by."""
    camera: Camera = Camera()

    @property
    def unit(self) -> str:
        """What a number in a result is."""
        return "relative depth" if self.scale == 1 else f"relative depth x{self.scale:g}"


def save(kind: str, path: Path, image: np.ndarray, depth: np.ndarray, style: Style, colours: Range | None = None) -> None:
    """Write one result.

    Args:
        kind: a key of `SUFFIXES`.
        path: of the file.
        image: (H, W, 3) uint8 RGB.
        depth: (H, W) float32, scaled.
        style: what is said of it.
        colours: ends of the colour scale; None takes the depth's own.

    Raises:
        OSError: it cannot be written.
    """
    with atomic_path(path) as partial:
        if kind == "depth":
            _save_png16(partial, depth, style)
        elif kind == "npy":
            np.save(partial, depth)
        elif kind == "ply":
            _save_ply(partial, image, depth, style)
        else:
            drawn = picture(depth, colours or Range.of(depth), style.unit, image if kind == "side" else None)
            partial.write_bytes(cv2.imencode(".png", drawn[..., ::-1])[1])


def png16(depth: np.ndarray) -> np.ndarray:
    """(H, W) uint16, depth × 256, rounded; 0 stands for none, so the nearest is 1, and 65535 is 256 or beyond."""
    return np.clip(np.rint(depth * PNG_FACTOR), 1, 65535).astype(np.uint16)


def _save_png16(path: Path, depth: np.ndarray, style: Style) -> None:
    words = PIL.PngImagePlugin.PngInfo()
    words.add_itxt("Description", f"value / {PNG_FACTOR} = {style.unit}; 65535 = {65535 / PNG_FACTOR:.0f} or more. {style.about}")
    PIL.Image.fromarray(png16(depth)).save(path, pnginfo=words, compress_level=3)


def _save_ply(path: Path, image: np.ndarray, depth: np.ndarray, style: Style) -> None:
    """All pixels as points, row by row; x right, y down, z forward."""
    fx, fy, cx, cy = style.camera.of(depth.shape)
    rows, columns = np.indices(depth.shape, np.float32)
    points = np.empty(depth.shape, [*((axis, "<f4") for axis in "xyz"), *((colour, "u1") for colour in COLOURS)])
    points["x"], points["y"], points["z"] = (columns - cx) / fx * depth, (rows - cy) / fy * depth, depth
    for channel, colour in enumerate(COLOURS):
        points[colour] = image[..., channel]
    about = " ".join(style.about.encode("ascii", "replace").decode().split())
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment x right, y down, z forward; in units of {style.unit}",
        f"comment camera: {style.camera}",
        f"comment {about}",
        f"element vertex {points.size}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in COLOURS),
        "end_header\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        points.tofile(file)


def write_video(path: Path, rate: float, frames: Iterable[np.ndarray]) -> None:
    """Write frames (H, W, 3) uint8 RGB, `rate` a second; the file is whole or absent.

    The first one's size is the video's. Odd sizes, which the codec has not, get their last row or column twice.

    Raises:
        OSError: the codec is not there, or not all frames were written; the codec tells of no full disk, so they are counted.
    """
    with atomic_path(path) as partial:
        file, count, size = cv2.VideoWriter(), 0, (0, 0)
        try:
            for count, frame in enumerate(frames, 1):
                if frame.shape[1] > WIDEST:
                    height = max(2, round(frame.shape[0] * WIDEST / frame.shape[1]))
                    frame = cv2.resize(frame, (WIDEST, height), interpolation=cv2.INTER_AREA)
                if count == 1:
                    size = tuple(side + side % 2 for side in frame.shape[:2])
                    if not file.open(str(partial), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*CODEC), rate, size[::-1]):
                        raise OSError(f"OpenCV cannot write {CODEC} video of {size[0]}×{size[1]}")
                frame = frame[: size[0], : size[1]]  # the bar's words may be wider than those of the first frame, or narrower
                missing = np.subtract(size, frame.shape[:2])
                frame = cv2.copyMakeBorder(frame, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
                file.write(np.ascontiguousarray(frame[..., ::-1]))
        finally:
            file.release()
        capture = cv2.VideoCapture(str(partial), cv2.CAP_FFMPEG)
        written = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        if written != count:
            raise OSError(f"{written} of {count} frames were written; is the disk full?")
