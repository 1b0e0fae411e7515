"""Shadows of the standing solids on the ground, drawn once per street into a map of how much sun reaches each spot."""

from dataclasses import dataclass

import cv2
import numpy as np

from data_scripts.miniature.solids import Prism, Solid
from data_scripts.miniature.street import Street

SUN = np.array([0.55, -0.75, -0.36]) / np.linalg.norm([0.55, -0.75, -0.36])
"""Direction to the sun in the world frame (y is down): behind the camera, to its right."""
CELL = 0.15
REACH = 45.0  # Half width, in metres, of the ground that gets shadows, around the centre line's box.


@dataclass(frozen=True)
class Shadows:
    """A map over the ground."""

    corner: np.ndarray  # (2,) x, z of the first cell.
    sunlight: np.ndarray  # (rows z, columns x) float32, 1 in the sun, less in shadow.

    def at(self, x: np.ndarray, z: np.ndarray) -> np.ndarray:
        """Sunlight at ground points, (N,) float32; outside of the map it shines everywhere."""
        left, near = self.corner.tolist()
        column = ((x - left) / CELL).astype(np.float32).clip(-1, self.sunlight.shape[1])
        row = ((z - near) / CELL).astype(np.float32).clip(-1, self.sunlight.shape[0])
        return cv2.remap(self.sunlight, column[None], row[None], cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=1.0)[0]


def cast_shadows(street: Street, shapes: list[Solid]) -> Shadows:
    """Project each solid along the sun's rays onto the ground and blur the edges to a penumbra."""
    corner = street.points.min(0) - REACH
    columns, rows = np.ceil((np.ptp(street.points, axis=0) + 2 * REACH) / CELL).astype(int)
    drawing = np.full((rows, columns), 255, np.uint8)
    for shape in shapes:
        ground = _outline(shape)
        ground = ground[:, [0, 2]] - ground[:, 1:2] * (SUN[[0, 2]] / SUN[1])
        cells = (ground - corner) / CELL
        hull = cv2.convexHull(np.round(cells * 16).astype(np.int32))
        cv2.fillConvexPoly(drawing, hull, 120, lineType=cv2.LINE_AA, shift=4)
    return Shadows(corner, cv2.GaussianBlur(drawing.astype(np.float32) / 255, (0, 0), 1.2))


def _outline(shape: Solid) -> np.ndarray:
    """(N, 3) points whose hull is the solid, or for round ones nearly so."""
    if isinstance(shape, Prism):
        return shape.corners
    angle = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    if np.isinf(shape.radii[1]):
        ring = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1) * shape.radii[0] + shape.centre
        return np.concatenate([ring, ring + np.array([0, shape.top, 0])])
    rings = [np.stack([np.cos(angle) * c, 0 * angle + s, np.sin(angle) * c], -1) for s, c in ((0, 1), (0.7, 0.71), (-0.7, 0.71))]
    return np.concatenate([*rings, [[0, 1, 0], [0, -1, 0]]]) * shape.radii + shape.centre
