"""The road of a street: its curved centre line, and street coordinates of any point on the ground.

World frame: x right, y down, z forward (metres), the ground is y = 0. Street coordinates: `s` is the path length
along the centre line, `d` the distance to the right of it. All angles are radians; heading 0 looks along +z.
"""

from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import cv2
import numpy as np
from scipy.spatial import cKDTree

STEP = 0.25  # Distance of neighbouring points of the centre line.
BEHIND = 40.0  # The road begins this far before s = 0.
CELL = 0.5  # Grid of the map from world to street coordinates; both are smooth, so bilinear interpolation is good to millimetres.
MARGIN = 60.0  # The map reaches this far beyond the centre line; points outside take the nearest cell's values.
AHEAD = 190.0  # A street goes on this far after its last camera.


class Plan(NamedTuple):
    """What a street and all that stands on it follow from."""

    seed: tuple[int, ...]  # Any integers.
    length: float  # How far along the road the camera goes, metres.
    bend: float = 0.25  # Largest heading of the road away from straight ahead, radians; at most about 1.2.
    wavelength: float = 260.0  # Length of a full left-right bend, metres.
    movers: int = 2  # Moving cars; the first, third, ... come towards the camera, the others drive ahead of it.
    pace: float = 10.5  # The camera's mean speed in m/s; those ahead of it are faster, so that it runs into none.


class Place(NamedTuple):
    """Where something stands on the ground."""

    point: np.ndarray  # (…, 2) x, z.
    heading: float | np.ndarray  # (…)


@dataclass(frozen=True)
class Street:
    """Centre line and its lookup grid, made by `build_street`."""

    s: np.ndarray  # (N,) path length.
    points: np.ndarray  # (N, 2) x, z.
    heading: np.ndarray  # (N,).
    corner: np.ndarray  # (2,) x, z of the map's first cell centre.
    grid: np.ndarray  # (rows z, columns x, 2) float32: s, d.

    def place(self, s: float | np.ndarray, d: float | np.ndarray, turn: float = 0.0) -> Place:
        """World position at street coordinates `s`, `d`, and the road's heading there, turned to the right by `turn`."""
        heading = np.interp(s, self.s, self.heading)
        x, z = (np.interp(s, self.s, self.points[:, k]) for k in (0, 1))
        return Place(np.stack([x + d * np.cos(heading), z - d * np.sin(heading)], -1), heading + turn)

    def curvature(self, s: float | np.ndarray) -> np.ndarray:
        """Change of heading per metre at `s`."""
        return (np.interp(np.add(s, 1.0), self.s, self.heading) - np.interp(np.subtract(s, 1.0), self.s, self.heading)) / 2

    def coordinates(self, x: np.ndarray, z: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Street coordinates `s`, `d` of ground points, two (N,) float32 arrays; N below 32,767 (OpenCV's limit)."""
        left, near = self.corner.tolist()
        column = ((x - left) / CELL).astype(np.float32).clip(0, self.grid.shape[1] - 1)
        row = ((z - near) / CELL).astype(np.float32).clip(0, self.grid.shape[0] - 1)
        both = cv2.remap(self.grid, column[None], row[None], cv2.INTER_LINEAR)[0]
        return both[:, 0], both[:, 1]


@lru_cache(maxsize=16)
def build_street(plan: Plan) -> Street:
    """Draw the centre line and tabulate its street coordinates.

    The heading is a sum of sines, so that the road never turns back onto itself.
    """
    rng = np.random.default_rng((*plan.seed, 0))
    s = np.arange(-BEHIND, plan.length + AHEAD, STEP)
    phase = rng.uniform(0, 2 * np.pi, 2)
    share = rng.uniform(0.75, 0.9)
    turns = 2 * np.pi * s / plan.wavelength
    heading = plan.bend * (share * np.sin(turns + phase[0]) + (1 - share) * np.sin(2.5 * turns + phase[1]))
    points = np.cumsum(np.stack([np.sin(heading), np.cos(heading)], -1) * STEP, 0)
    points -= points[np.argmin(abs(s))]
    corner = points.min(0) - MARGIN
    columns, rows = np.ceil((np.ptp(points, axis=0) + 2 * MARGIN) / CELL).astype(int) + 1
    x, z = np.meshgrid(corner[0] + CELL * np.arange(columns), corner[1] + CELL * np.arange(rows))
    nearest = cKDTree(points).query(np.stack([x.ravel(), z.ravel()], -1))[1].reshape(x.shape)
    dx, dz = x - points[nearest, 0], z - points[nearest, 1]
    sin, cos = np.sin(heading[nearest]), np.cos(heading[nearest])
    grid = np.stack([s[nearest] + dx * sin + dz * cos, dx * cos - dz * sin], -1).astype(np.float32)
    return Street(s, points, heading, corner, grid)
