"""Colours of the world: patterns and band-limited noise anchored to the surfaces, sunlight, haze, clouds.

Noise is looked up in tiles that repeat without a seam. Detail finer than a ray's footprint is faded out, so that what
supersampling cannot resolve does not flicker from frame to frame.
"""

import numpy as np

from data_scripts.miniature.cast import FIRST, GROUND, SKY, Hits, Rays, surfaces
from data_scripts.miniature.ground import ground_colour
from data_scripts.miniature.noise import BLOTCH, GRAIN, fade, noise
from data_scripts.miniature.scene import Scene
from data_scripts.miniature.shadows import SUN
from data_scripts.miniature.solids import Quadric, Solid, Surface

CHUNK = 16384  # Rays coloured at a time: they fit a core's cache, and OpenCV's lookups take at most 32,767.
HAZE = np.array([[0.74], [0.79], [0.85]], np.float32)
HAZE_LENGTH = 700.0  # Metres over which haze hides 63 % of a colour.
AMBIENT, DIRECT = 0.6, 0.5  # Light from the sky, and from the sun at normal incidence.


def shade(scene: Scene, shapes: list[Solid], rays: Rays, hits: Hits) -> np.ndarray:
    """Colour of each ray.

    Args:
        scene: gives ground, sky and sun.
        shapes: the solids that were hit.
        rays, hits: of shape (H, W).

    Returns:
        (3, H, W) float32 RGB, 0..1.
    """
    index, nearness, table = hits.index.ravel(), hits.nearness.ravel(), surfaces(shapes)
    x, y = (np.broadcast_to(a, hits.index.shape).ravel() for a in (rays.x, rays.y))
    rotation, origin = rays.pose[:3, :3].astype(np.float32), rays.pose[:3, 3]
    focal = 1 / float(rays.x[0, 1] - rays.x[0, 0])
    colour = np.empty((3, index.size), np.float32)
    order = np.argsort(index, kind="stable")
    ends = np.cumsum(np.bincount(index))
    for number in np.flatnonzero(np.diff(ends, prepend=0)):
        start = ends[number - 1] if number else 0
        for low in range(start, ends[number], CHUNK):
            rows = order[low : min(low + CHUNK, ends[number])]
            direction = rotation @ np.stack([x[rows], y[rows], np.ones(rows.size, np.float32)])  # (3, n)
            if number == SKY:
                colour[:, rows] = _sky(scene, direction)
                continue
            depth = 1 / nearness[rows]
            points = direction * depth + origin.astype(np.float32)[:, None]  # (3, n), metres
            if number == GROUND:
                footprint = depth**2 / (focal * float(-origin[1]))
                albedo, light = ground_colour(scene, points, footprint)
                light = AMBIENT + DIRECT * float(-SUN[1]) * light
            else:
                albedo, light = _solid(*table[number - FIRST], points, depth, focal, origin)
            clear = np.exp(depth / -HAZE_LENGTH)
            colour[:, rows] = albedo * (light * clear) + HAZE * (1 - clear)
    return np.clip(colour, 0, 1, out=colour).reshape(3, *hits.index.shape)


def _sky(scene: Scene, direction: np.ndarray) -> np.ndarray:
    """A gradient with clouds; it depends on direction alone, so it lies infinitely far away."""
    x, y, z = direction / np.linalg.norm(direction, axis=0)
    height = np.maximum(-y, 0)
    blue = HAZE + np.float32(0.03) - np.array([[0.75], [0.55], [0.25]], np.float32) * height
    x, z = x / (height + 0.25) + scene.seed * 9, z / (height + 0.25)
    cloud = np.clip(0.45 + 0.4 * (noise(BLOTCH, x / 9, z / 9) + 0.35 * noise(GRAIN, x / 7, z / 7)), 0, 1)  # of two sizes
    return blue + (0.95 - blue) * cloud


def _solid(shape: Solid, surface: Surface, points, depth, focal, origin) -> tuple[np.ndarray, np.ndarray]:
    """Albedo (3, n) and light (n,) of points (3, n) on one surface of a solid."""
    if isinstance(shape, Quadric):
        normal = (points - shape.centre.astype(np.float32)[:, None]) * (1 / shape.radii**2).astype(np.float32)[:, None]
        sun = np.maximum(SUN.astype(np.float32) @ normal / np.linalg.norm(normal, axis=0), -0.4)
        return ROUND[surface.material](surface, points, depth / focal), AMBIENT + DIRECT * sun
    offset = points - surface.origin[:, None].astype(np.float32)
    u, v = surface.along.astype(np.float32) @ offset, surface.up.astype(np.float32) @ offset
    distance = abs(float(surface.normal @ (origin - surface.origin)))
    footprint = np.maximum(depth**2 / (focal * max(distance, 0.05)), depth / focal)
    light = AMBIENT + DIRECT * max(0.0, float(SUN @ surface.normal))
    return FLAT[surface.material](surface, u, v, footprint), np.full(depth.shape, light, np.float32)


def _tinted(surface: Surface, factor: np.ndarray) -> np.ndarray:
    """The surface's colour times a factor (n,): (3, n)."""
    return _column(surface.colour) * factor


def _column(colour: tuple[float, float, float]) -> np.ndarray:
    """A colour as (3, 1) float32."""
    return np.asarray(colour, np.float32)[:, None]


def _rough(surface: Surface, u, v, footprint, fine: float, coarse: float, size: float = 5.0) -> np.ndarray:
    """Factor (n,) around 1: grain that repeats after `size` metres, and blotches four times as large."""
    shift = surface.seed * 37
    grain = fine * fade(footprint, size / 100) * noise(GRAIN, u / size + shift, v / size + 2 * shift)
    return 1 + grain + coarse * noise(BLOTCH, u / (4 * size) + shift, v / (4 * size))


def _plain(surface: Surface, u, v, footprint) -> np.ndarray:
    return _tinted(surface, _rough(surface, u, v, footprint, 0.06, 0.04))


def _facade(surface: Surface, u, v, footprint) -> np.ndarray:
    """Plaster or brick, with rows of windows, a plinth and a ledge on each storey."""
    width = surface.extent[0] / max(1, round(surface.extent[0] / (2.3 + 1.2 * surface.seed)))
    column, storey = (u + surface.extent[0] / 2) / width, v / 3.0
    across, above = column - np.floor(column), storey - np.floor(storey)
    factor = _rough(surface, u, v, footprint, 0.1, 0.09)
    if surface.seed > 0.5:
        row = v / 0.11
        stretch = u / 0.34 + 0.5 * (np.floor(row) % 2)
        mortar = ((row - np.floor(row)) < 0.16) | ((stretch - np.floor(stretch)) < 0.07)
        factor += 0.22 * mortar * fade(footprint, 0.03)
    factor *= np.where(v < 0.5, 0.7, 1.0) + np.where(above < 0.05, 0.15, 0.0)
    colour = _tinted(surface, factor)
    half = 0.2 + 0.1 * ((surface.seed * 7) % 1)
    inside = np.minimum(half - abs(across - 0.5), np.minimum(above - 0.28, 0.82 - above))
    variety = noise(GRAIN, np.floor(column) * 0.377 + surface.seed, np.floor(storey) * 0.611)
    glass = _column((0.16, 0.2, 0.25)) * (1 + 0.45 * variety)
    frame = (inside < 0.03) | (abs(across - 0.5) < 0.015)
    window = np.where(frame, np.float32(0.82 - 0.5 * (surface.seed * 3 % 1 > 0.6)), glass)
    return np.where(inside > 0, window, colour)


def _roof(surface: Surface, u, v, footprint) -> np.ndarray:
    tiles = v / 0.3
    return _tinted(surface, _rough(surface, u, v, footprint, 0.14, 0.1) - 0.2 * ((tiles - np.floor(tiles)) < 0.25) * fade(footprint, 0.08))


def _hedge(surface: Surface, u, v, footprint) -> np.ndarray:
    return _tinted(surface, 0.85 * _rough(surface, u, v, footprint, 0.38, 0.15, size=3.0).clip(0.25, 2))


def _fence(surface: Surface, u, v, footprint) -> np.ndarray:
    slat = u / 0.14
    gap = (slat - np.floor(slat)) < 0.22
    return _tinted(surface, _rough(surface, u, v, footprint, 0.1, 0.1) * (1 - 0.6 * gap * fade(footprint, 0.1)))


def _sign(surface: Surface, u, v, footprint) -> np.ndarray:
    inner = (abs(u) < 0.24) & (abs(v - 0.325) < 0.24)
    bar = (abs(v - 0.325) < 0.06) & (abs(u) < 0.18)
    return np.where(inner ^ bar, np.float32(0.88), _column(surface.colour))


def _paint(surface: Surface, u, v, footprint) -> np.ndarray:
    return _tinted(surface, 1 + 0.05 * noise(BLOTCH, u / 3 + surface.seed, v / 3))


def _front(surface: Surface, u, v, footprint) -> np.ndarray:
    """Headlights on both sides of a dark grille."""
    colour = _paint(surface, u, v, footprint)
    colour[:, (abs(u) > 0.5) & (abs(u) < 0.76)] = 0.85
    colour[:, (abs(u) < 0.38) & (v > 0.03) & (v < 0.2)] = 0.08
    return colour


def _back(surface: Surface, u, v, footprint) -> np.ndarray:
    """Tail lights and a number plate."""
    colour = _paint(surface, u, v, footprint)
    colour[:, (abs(u) > 0.55) & (v > 0.08)] = _column((0.6, 0.06, 0.05))
    colour[:, (abs(u) < 0.26) & (v > 0.12) & (v < 0.24)] = 0.8
    return colour


def _doors(surface: Surface, u, v, footprint) -> np.ndarray:
    """A dark sill, joints of the doors and handles."""
    colour = _paint(surface, u, v, footprint)
    joint = (abs(abs(u - 0.1) - 0.95) < 0.012) | (abs(u - 0.1) < 0.012) | (v < 0.1)
    handle = (abs(abs(u + 0.3) - 0.45) < 0.09) & (abs(v - 0.55) < 0.02)
    colour[:, joint | handle] *= 0.35
    return colour


def _side(surface: Surface, u, v, footprint) -> np.ndarray:
    """The cabin's side: glass with pillars, under a painted roof."""
    glass = (abs(u - 0.03) > 0.05) & (v > 0.06) & (v < surface.extent[1] - 0.07)
    shine = 0.16 + 0.05 * noise(BLOTCH, u / 2 + surface.seed, v / 2)
    return np.where(glass, shine, _paint(surface, u, v, footprint))


def _wheel(surface: Surface, u, v, footprint) -> np.ndarray:
    radius = np.hypot(u, v - 0.32)
    spoke = np.cos(5 * np.arctan2(v - 0.32, u)) > 0.1
    return np.where((radius < 0.2) & (spoke | (radius < 0.07)), np.full((3, 1), 0.55, np.float32), np.float32(0.06))


def _leaves(surface: Surface, points, footprint) -> np.ndarray:
    """Foliage: three projections of grain, so that it is stretched nowhere."""
    x, y, z = points / np.float32(3.2) + np.float32(surface.seed * 7)
    grain = noise(GRAIN, x, y) + noise(GRAIN, y + 0.3, z) + noise(GRAIN, z, x + 0.6)
    x, y, z = points / np.float32(9.0)
    clump = noise(BLOTCH, x, y) + noise(BLOTCH, z, y + 0.5)
    factor = (1 + 0.3 * fade(footprint, 0.05) * grain + 0.22 * clump).clip(0.2, 2.2)
    return _tinted(surface, 0.95 * factor)


def _forest(surface: Surface, points, footprint) -> np.ndarray:
    """Far woods: blotches the size of trees."""
    x, y, z = points / np.float32(60)
    return _tinted(surface, (1 + 0.22 * noise(GRAIN, x + surface.seed, 2 * y) + 0.2 * noise(GRAIN, z, 2 * y)).clip(0.3, 2))


def _bark(surface: Surface, points, footprint) -> np.ndarray:
    x, y, z = points
    return _tinted(surface, 1 + 0.35 * fade(footprint, 0.04) * noise(GRAIN, (x + z) / 1.2 + surface.seed, y / 4))


def _metal(surface: Surface, points, footprint) -> np.ndarray:
    return _tinted(surface, 1 + 0.1 * noise(BLOTCH, points[1] / 3 + surface.seed, points[0]))


def _bollard(surface: Surface, points, footprint) -> np.ndarray:
    """White with a red band."""
    band = (points[1] > -0.85) & (points[1] < -0.65)
    return np.where(band, _column((0.7, 0.1, 0.1)), _column(surface.colour))


_PATTERNS = (_plain, _facade, _roof, _hedge, _fence, _sign, _paint, _front, _back, _doors, _side, _wheel)
FLAT = {pattern.__name__[1:]: pattern for pattern in _PATTERNS} | {"glass": _plain}
ROUND = {"leaves": _leaves, "forest": _forest, "bark": _bark, "metal": _metal, "bollard": _bollard}
