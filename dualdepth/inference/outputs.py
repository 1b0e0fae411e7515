"""What is written of an image and its depth: 16-bit PNG, colours, array, point cloud. Each file is whole or absent."""

from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from dualdepth.files import atomic_path
from dualdepth.inference.camera import Camera, point_cloud
from dualdepth.inference.pictures import Range, colour_picture, side_by_side

PNG_FACTOR = 256
"""A PNG's value / 256 is the depth, as in KITTI's depth maps."""
SUFFIXES = {"depth": ".depth.png", "colour": ".colour.png", "side": ".side.png", "npy": ".depth.npy", "ply": ".ply"}
"""Endings of an image's results, by kind."""
SIDE_VIDEO = ".side.mp4"
ENDINGS = (*SUFFIXES.values(), SIDE_VIDEO)


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
            picture = colour_picture if kind == "colour" else side_by_side
            drawn = picture(image, depth, colours or Range.of(depth), style.unit)
            partial.write_bytes(cv2.imencode(".png", drawn[..., ::-1])[1])


def png16(depth: np.ndarray) -> np.ndarray:
    """(H, W) uint16, depth × 256, rounded; 0 stands for none, so the nearest is 1, and 65535 is 256 or beyond."""
    return np.clip(np.rint(depth * PNG_FACTOR), 1, 65535).astype(np.uint16)


def _save_png16(path: Path, depth: np.ndarray, style: Style) -> None:
    import PIL.Image
    import PIL.PngImagePlugin

    words = PIL.PngImagePlugin.PngInfo()
    words.add_itxt("Description", f"value / {PNG_FACTOR} = {style.unit}; 65535 = {65535 / PNG_FACTOR:.0f} or more. {style.about}")
    PIL.Image.fromarray(png16(depth)).save(path, pnginfo=words, compress_level=3)


def _save_ply(path: Path, image: np.ndarray, depth: np.ndarray, style: Style) -> None:
    points = point_cloud(depth, image, style.camera.of(depth.shape))
    about = " ".join(style.about.encode("ascii", "replace").decode().split())
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment x right, y down, z forward; in units of {style.unit}",
        f"comment camera: {style.camera}",
        f"comment {about}",
        f"element vertex {points.size}",
        *(f"property float {axis}" for axis in "xyz"),
        *(f"property uchar {colour}" for colour in ("red", "green", "blue")),
        "end_header\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        points.tofile(file)
