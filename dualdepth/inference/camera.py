"""Intrinsics for point clouds: given, or a stated default."""

import math
from typing import NamedTuple

import numpy as np

from dualdepth.errors import InputError

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
        lengths = [*(self.intrinsics or ())[:2], *([] if self.focal is None else [self.focal])]
        if not all(math.isfinite(value) and value > 0 for value in lengths) or not all(map(math.isfinite, self.intrinsics or ())):
            raise InputError(f"intrinsics {list(self.intrinsics or lengths)}: focal lengths must be positive and all numbers finite")
        if not 0 < self.field_of_view < 180:
            raise InputError(f"field of view {self.field_of_view}: must be between 0 and 180 degrees")
        return self

    def of(self, size: tuple[int, int]) -> tuple[float, float, float, float]:
        """fx, fy, cx, cy of an image of `size` (height, width)."""
        if self.intrinsics:
            return self.intrinsics
        height, width = size
        focal = self.focal or width / 2 / math.tan(math.radians(self.field_of_view) / 2)
        return focal, focal, (width - 1) / 2, (height - 1) / 2

    def __str__(self) -> str:
        if self.intrinsics:
            return "fx {} fy {} cx {} cy {} as given".format(*self.intrinsics)
        if self.focal:
            return f"focal length {self.focal} pixels as given, principal point in the middle"
        by = "by default, as KITTI's" if self.field_of_view == KITTI_FIELD_OF_VIEW else "as given"
        return f"horizontal field of view {self.field_of_view:.1f} degrees {by}, principal point in the middle"


def point_cloud(depth: np.ndarray, image: np.ndarray, intrinsics: tuple[float, float, float, float]) -> np.ndarray:
    """Points of all pixels, row by row.

    Args:
        depth: (H, W) float32.
        image: (H, W, 3) uint8 RGB.
        intrinsics: fx, fy, cx, cy in pixels.

    Returns:
        (H·W,) records x, y, z (float32, in units of the depth; x right, y down, z forward) and red, green, blue (uint8).
    """
    fx, fy, cx, cy = intrinsics
    rows, columns = np.indices(depth.shape, np.float32)
    points = np.empty(depth.size, [*((axis, "<f4") for axis in "xyz"), *((colour, "u1") for colour in ("red", "green", "blue"))])
    points["x"] = ((columns - cx) / fx * depth).ravel()
    points["y"] = ((rows - cy) / fy * depth).ravel()
    points["z"] = depth.ravel()
    for channel, colour in enumerate(("red", "green", "blue")):
        points[colour] = image[..., channel].ravel()
    return points
