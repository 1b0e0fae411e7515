"""The two kinds of solids that streets are made of, and how houses and cars are put together from them.

A `Prism` is a convex outline swept along a line: houses, cars, hedges, fences, signs. A `Quadric` is an ellipsoid
(crowns, bushes, hills) or an upright cylinder (trunks, poles). World frame as in `street.py`.
"""

from typing import NamedTuple

import numpy as np

from data_scripts.miniature.street import Place

ROAD, SIDEWALK, BUILDING, FENCE, POLE, SIGN, VEGETATION, TERRAIN, SKY, CAR = 0, 1, 2, 4, 5, 7, 8, 9, 10, 13
"""Cityscapes' training ids of what the world holds."""


class Surface(NamedTuple):
    """What one face looks like; its texture coordinates are metres along `along` and `up` from `origin`."""

    material: str  # Name of a pattern in `colours.py`.
    label: int
    colour: tuple[float, float, float]  # RGB in 0..1.
    seed: float  # 0..1; moves and varies the texture.
    normal: np.ndarray
    origin: np.ndarray
    along: np.ndarray
    up: np.ndarray
    extent: tuple[float, float]  # Width and height of the face, metres; the origin is at the middle of the lower edge.
    moving: bool = False


class Prism(NamedTuple):
    """The points x with normals · x <= offsets."""

    normals: np.ndarray  # (F, 3), outward.
    offsets: np.ndarray  # (F,)
    corners: np.ndarray  # (8, 3), of a box around it.
    surfaces: list[Surface]  # One a face.


class Quadric(NamedTuple):
    """An ellipsoid, or with `radii[1] = inf` an upright cylinder from `top` to the ground."""

    centre: np.ndarray
    radii: np.ndarray
    top: float
    corners: np.ndarray  # (8, 3), of a box around it.
    surfaces: list[Surface]  # The one that it has.


Solid = Prism | Quadric


def box_corners(centre: np.ndarray, axes: np.ndarray, half: np.ndarray) -> np.ndarray:
    """The (8, 3) corners of a box with unit `axes` as rows and half sizes `half`."""
    signs = np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, 8).T
    return centre + (signs * half) @ axes


def prism(
    place: Place,
    outline: list[tuple[float, float]],
    half: float,
    faces: list[tuple[str, tuple[float, float, float]]],
    label: int,
    seed: float,
    moving: bool = False,
) -> Prism:
    """Sweep a convex outline.

    Args:
        place: origin and direction of the outline's first axis; its second axis points up.
        outline: convex, counter-clockwise when the first axis points right; metres.
        half: half of the length of the sweep, to both sides of `place`.
        faces: materials and colours of the outline's edges in order, then of the two ends.
        label: Cityscapes id.
        seed: see `Surface`.
        moving: whether this belongs to something that moves.
    """
    sin, cos = np.sin(place.heading), np.cos(place.heading)
    first, up, sweep = np.array([sin, 0, cos]), np.array([0.0, -1, 0]), np.array([cos, 0, -sin])
    base = np.array([place.point[0], 0, place.point[1]])
    points = np.asarray(outline, float)
    low, high = points.min(0), points.max(0)
    middle = (low + high) / 2
    planes = []  # normal, origin, along, up, extent
    for p, q in zip(points, np.roll(points, -1, 0)):
        edge, (start, rise) = q - p, (p, q - p) if p[1] <= q[1] else (q, p - q)
        length = np.hypot(*edge)
        normal, origin = (edge[1] * first - edge[0] * up) / length, base + start[0] * first + start[1] * up
        planes.append((normal, origin, sweep, rise[0] / length * first + rise[1] / length * up, (2 * half, length)))
    for side in (-1, 1):
        origin = base + side * half * sweep + middle[0] * first + low[1] * up
        planes.append((side * sweep, origin, first, up, tuple(high - low)))
    corners = box_corners(base + middle[0] * first + middle[1] * up, np.stack([first, up, sweep]), np.array([*(high - low) / 2, half]))
    surfaces = [Surface(material, label, colour, seed, *plane, moving) for (material, colour), plane in zip(faces, planes)]
    return Prism(np.array([p[0] for p in planes]), np.array([p[0] @ p[1] for p in planes]), corners, surfaces)


def block(place: Place, size: tuple[float, float, float], material: str, label: int, colour, seed: float, above: float = 0.0) -> Prism:
    """A box of `size` = (length along the heading, width, height), `above` metres over the ground."""
    length, width, height = size
    outline = [(-length / 2, above), (length / 2, above), (length / 2, above + height), (-length / 2, above + height)]
    return prism(place, outline, width / 2, [(material, colour)] * 6, label, seed)


def house(place: Place, size: tuple[float, float, float], wall, roof, seed: float, gable: float) -> Prism:
    """A house of `size` = (depth, width along the street, height of the eaves); `gable` is the roof's rise, 0 for a flat one.

    The place's heading points away from the street.
    """
    depth, width, height = size
    outline = [(-depth / 2, 0.0), (depth / 2, 0.0), (depth / 2, height), (-depth / 2, height)]
    above = [("roof", roof)]
    if gable:
        outline.insert(3, (0.0, height + gable))
        above *= 2
    return prism(place, outline, width / 2, [("plain", wall), ("facade", wall), *above, *[("facade", wall)] * 3], BUILDING, seed)


def car(place: Place, paint, seed: float, moving: bool = False) -> list[Prism]:
    """A car heading along `place`: the dark ground below it, body, cabin and two axles with wheels."""
    scale = 0.95 + 0.15 * seed
    high = 1.25 if seed > 0.7 else 1.0
    body = [(-2.0, 0.22), (2.0, 0.22), (2.1, 0.5), (2.0, 0.74), (1.0, 0.94), (-1.95, 0.98), (-2.1, 0.6)]
    cabin = [(-1.95, 0.9), (1.1, 0.9), (0.35, 1.45 * high), (-1.5 - 0.3 * (high > 1), 1.47 * high)]
    body, cabin = ([(scale * x, scale * y) for x, y in outline] for outline in (body, cabin))
    dark, glass = ("plain", (0.05, 0.05, 0.055)), ("glass", (0.13, 0.15, 0.17))
    shade = prism(place, [(-2.2, 0.0), (2.2, 0.0), (2.2, 0.03), (-2.2, 0.03)], 0.95, [dark] * 6, ROAD, seed, moving)
    painted = [(part, paint) for part in ("front", "front", "paint", "paint", "back", "back", "doors", "doors")]
    lower = prism(place, body, 0.86 * scale, [dark, *painted], CAR, seed, moving)
    roof, side = ("paint", paint), ("side", paint)
    upper = prism(place, cabin, 0.76 * scale, [dark, glass, roof, glass, side, side], CAR, seed, moving)
    angles = np.arange(10) * 2 * np.pi / 10
    wheels = []
    for axle in (-1.3 * scale, 1.3 * scale):
        rim = [(axle + 0.32 * np.cos(a), 0.32 + 0.32 * np.sin(a)) for a in angles]
        wheels.append(prism(place, rim, 0.875 * scale, [dark] * 10 + [("wheel", dark[1])] * 2, CAR, seed, moving))
    return [shade, lower, upper, *wheels]


def ellipsoid(centre, radii, material: str, label: int, colour, seed: float) -> Quadric:
    """An ellipsoid with its axes along the world's; `centre` and `radii` as x, y, z."""
    centre, radii = np.asarray(centre, float), np.asarray(radii, float)
    return Quadric(centre, radii, -np.inf, box_corners(centre, np.eye(3), radii), _round_surface(material, label, colour, seed))


def cylinder(point, radius: float, height: float, material: str, label: int, colour, seed: float) -> Quadric:
    """An upright cylinder on the ground at `point` (x, z)."""
    centre = np.array([point[0], 0.0, point[1]])
    corners = box_corners(centre - [0, height / 2, 0], np.eye(3), np.array([radius, height / 2, radius]))
    return Quadric(centre, np.array([radius, np.inf, radius]), -height, corners, _round_surface(material, label, colour, seed))


def _round_surface(*look) -> list[Surface]:
    """The one surface of a quadric, whose place and direction differ from point to point."""
    return [Surface(*look, *np.zeros((4, 3)), (1.0, 1.0))]
