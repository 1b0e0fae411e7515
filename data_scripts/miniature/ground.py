"""What the ground is and looks like: asphalt with markings, kerb, sidewalk slabs, grass."""

import numpy as np

from data_scripts.miniature.noise import BLOTCH, GRAIN, fade, noise
from data_scripts.miniature.scene import Scene
from data_scripts.miniature.solids import ROAD, SIDEWALK, TERRAIN
from data_scripts.miniature.street import Street

STRIPS = (
    (4.0, ROAD, (0.36, 0.36, 0.37), 0.05, 0.05),  # the paper's region of low texture
    (6.0, ROAD, (0.33, 0.325, 0.33), 0.06, 0.06),  # for parking
    (6.25, SIDEWALK, (0.62, 0.61, 0.59), 0.05, 0.03),  # the kerb
    (8.2, SIDEWALK, (0.53, 0.51, 0.49), 0.06, 0.05),
    (np.inf, TERRAIN, (0.3, 0.4, 0.16), 0.3, 0.16),  # grass, of rich texture
)
"""Strips of ground, each to its largest |d|: Cityscapes' id, colour, contrast of grain and of blotches."""
EDGES, LABELS, BASE, FINE, COARSE = map(np.array, zip(*STRIPS), (float, np.uint8, *[np.float32] * 3))


def ground_label(street: Street, x: np.ndarray, z: np.ndarray) -> np.ndarray:
    """Cityscapes ids of ground points, (N,) uint8; N below 32,767."""
    return LABELS[np.searchsorted(EDGES, abs(street.coordinates(x, z)[1]))]


def ground_colour(scene: Scene, points: np.ndarray, footprint: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (3, N) and sunlight (N,) of ground points.

    Args:
        scene: gives street and shadows.
        points: (3, N) world points, N below 32,767.
        footprint: (N,) metres that a ray covers along the ground.
    """
    x, _, z = points
    s, d = scene.street.coordinates(x, z)
    strip = np.searchsorted(EDGES, abs(d))
    shift = np.float32(scene.seed * 5)
    grain = noise(GRAIN, x / 4 + shift, z / 4) * fade(footprint, 0.05) + 0.6 * noise(GRAIN, x / 23 + shift, z / 23) * fade(footprint, 0.3)
    blotch = noise(BLOTCH, x / 31 + shift, z / 31) + 0.7 * noise(BLOTCH, x / 140, z / 140 + shift)
    albedo = BASE.T[:, strip] * (1 + FINE[strip] * grain + COARSE[strip] * blotch)
    albedo[0] += np.float32(0.05) * (strip == 4) * blotch
    slab = (strip == 3) & ((_part(s, 1.2) < 0.03) | (_part(abs(d) - 6.25, 0.65) < 0.04))
    albedo *= 1 - 0.3 * slab * fade(footprint, 0.08)
    cracks = (strip <= 1) & (abs(noise(BLOTCH, x / 17 + 0.3, z / 17 + shift)) < 0.012)
    albedo *= 1 - 0.25 * cracks * fade(footprint, 0.1)
    white = _markings(scene, s, d)
    albedo += white * ((0.62 + 0.08 * grain) - albedo)
    return albedo, scene.shadows.at(x, z)


def _part(value: np.ndarray, period: float) -> np.ndarray:
    """Position within a repeating pattern, 0..1."""
    turns = value / np.float32(period)
    return turns - np.floor(turns)


def _markings(scene: Scene, s: np.ndarray, d: np.ndarray) -> np.ndarray:
    """1 where the road is painted: dashed centre line, edge lines, parking bays, zebra crossings."""
    side = abs(d)
    centre = (side < 0.07) & (_part(s, 9.0) < 0.4)
    edge = abs(side - 3.85) < 0.06
    bay = (side > 4.0) & (side < 5.95) & (_part(s + 40 * scene.seed, 6.0) < 0.02)
    zebra = (side < 3.6) & (abs(_part(s + 90 * scene.seed, 85.0) - 0.5) < 0.018) & (_part(d + 0.25, 1.0) < 0.5)
    return (centre | edge | bay | zebra).astype(np.float32)
