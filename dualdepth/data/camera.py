"""A pinhole camera: of the films that a data set is made of, and of the images that become point clouds."""

import math
from typing import NamedTuple

import numpy as np


class Camera(NamedTuple):
    """A camera in pixels of its frames; pixel (0, 0) is the centre of the first pixel."""

    fx: float
    fy: float
    cx: float
    cy: float
    size: tuple[int, int]  # (height, width) of the frames.
    origin: str  # Where the numbers are from.
    distortion: tuple[float, ...] = ()  # OpenCV's k1, k2, p1, p2, k3; empty: none.

    @property
    def matrix(self) -> np.ndarray:
        """(3, 3) float64."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]], np.float64)

    @property
    def field(self) -> float:
        """Horizontal field of view in degrees."""
        return 2 * math.degrees(math.atan(self.size[1] / 2 / self.fx))


def focal_length(field: float, width: int) -> float:
    """Focal length in pixels of a horizontal field of view in degrees."""
    return width / 2 / math.tan(math.radians(field) / 2)


def centred_camera(focal: float, size: tuple[int, int], origin: str) -> Camera:
    """Camera with square pixels and its axis through the middle."""
    return Camera(focal, focal, (size[1] - 1) / 2, (size[0] - 1) / 2, size, origin)
