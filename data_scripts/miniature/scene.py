"""Build a street scene by seed: houses, trees, hedges, poles, parked and moving cars along a curved road."""

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from data_scripts.miniature import solids
from data_scripts.miniature.shadows import Shadows, cast_shadows
from data_scripts.miniature.solids import Prism, Quadric, Solid
from data_scripts.miniature.street import Place, Plan, Street, build_street

LANE = 1.9  # The middle of the right-hand lane, metres right of the centre line.
PAINTS = [
    (0.75, 0.76, 0.78),
    (0.1, 0.1, 0.11),
    (0.45, 0.05, 0.05),
    (0.1, 0.16, 0.36),
    (0.85, 0.85, 0.83),
    (0.3, 0.32, 0.33),
    (0.2, 0.3, 0.22),
]
WALLS = [
    (0.78, 0.7, 0.55),
    (0.82, 0.8, 0.76),
    (0.55, 0.28, 0.2),
    (0.6, 0.58, 0.55),
    (0.75, 0.55, 0.38),
    (0.66, 0.7, 0.62),
    (0.5, 0.42, 0.36),
]
ROOFS = [(0.42, 0.2, 0.15), (0.28, 0.25, 0.25), (0.36, 0.26, 0.2)]
LEAVES = [(0.2, 0.33, 0.1), (0.27, 0.36, 0.12), (0.16, 0.28, 0.12), (0.34, 0.38, 0.14)]


class Mover(NamedTuple):
    """A car that drives along the road: at street coordinates `start` + `speed`·time, `d`."""

    start: float
    speed: float  # Metres per second along `s`; negative ones come towards the camera.
    d: float
    paint: tuple[float, float, float]
    seed: float


@dataclass
class Scene:
    """One street with everything in it; `shapes(time)` gives the solids at a moment."""

    street: Street
    seed: float  # 0..1; moves the textures of ground and sky.
    prisms: list[Prism] = field(default_factory=list)
    quadrics: list[Quadric] = field(default_factory=list)
    movers: list[Mover] = field(default_factory=list)
    shadows: Shadows | None = None

    def shapes(self, time: float) -> list[Solid]:
        """Standing solids, and the moving cars where they are at `time` (seconds)."""
        shapes: list[Solid] = [*self.prisms, *self.quadrics]
        for mover in self.movers:
            s = mover.start + mover.speed * time
            if self.street.s[0] < s < self.street.s[-1]:
                place = self.street.place(s, mover.d, np.pi if mover.speed < 0 else 0.0)
                shapes += solids.car(place, mover.paint, mover.seed, moving=True)
        return shapes


def build_scene(plan: Plan) -> Scene:
    """Build the street of a plan with everything on it."""
    rng = np.random.default_rng((*plan.seed, 1))
    scene = Scene(build_street(plan), rng.uniform())
    density = rng.choice([0.35, 0.65, 0.9])
    for side in (-1, 1):
        _houses(scene, rng, side, density)
        _trees(scene, rng, side, spacing=5 + 12 * density)
        _hedges(scene, rng, side, density)
        _poles(scene, rng, side)
        _parked(scene, rng, side, density)
    _hills(scene, rng)
    scene.shadows = cast_shadows(scene.street, [*scene.prisms, *scene.quadrics])
    scene.movers = [_mover(rng, k, plan) for k in range(plan.movers)]
    return scene


def _pick(rng: np.random.Generator, colours: list[tuple[float, float, float]], spread: float = 0.12) -> tuple[float, float, float]:
    """One of the colours, a little lighter or darker."""
    colour = np.array(colours[rng.integers(len(colours))]) * (1 + rng.uniform(-spread, spread)) + rng.uniform(-0.02, 0.02, 3)
    return tuple(float(c) for c in colour.clip(0.02, 0.95))


def _along(scene: Scene, rng: np.random.Generator, low: float, high: float):
    """Places along the road, a random distance in [low, high] apart."""
    s = scene.street.s[0] + rng.uniform(0, high)
    while s < scene.street.s[-1]:
        yield s
        s += rng.uniform(low, high)


def _clear(scene: Scene, shape: Solid, distance: float) -> bool:
    """Whether the solid's box stays `distance` away from the centre line, also where the road bends towards it."""
    low, high = shape.corners.min(0), shape.corners.max(0)
    x, z = np.meshgrid(np.linspace(low[0], high[0], 5), np.linspace(low[2], high[2], 5))
    return bool(abs(scene.street.coordinates(x.ravel(), z.ravel())[1]).min() > distance)


def _houses(scene: Scene, rng: np.random.Generator, side: int, density: float) -> None:
    """A row along the street and a sparser one behind; `density` is the chance that a plot is built on."""
    tall = rng.uniform(0.15, 0.6)
    for row, setback in enumerate((rng.uniform(9.5, 13.0), 36.0)):
        s = scene.street.s[0]
        while s < scene.street.s[-1]:
            width, depth = rng.uniform(8, 17), rng.uniform(8, 13)
            storeys = rng.integers(3, 6) if rng.uniform() < tall else rng.integers(1, 4)
            d = side * (setback + rng.uniform(0, 2.5 + 12 * row) + depth / 2)
            place = scene.street.place(s + width / 2, d, side * np.pi / 2)
            size = (depth, width, 3.0 * storeys + rng.uniform(0.3, 1.0))
            gable = 0.0 if storeys > 3 else rng.uniform(1.8, 3.2)
            home = solids.house(place, size, _pick(rng, WALLS), _pick(rng, ROOFS), rng.uniform(), gable)
            if rng.uniform() < density and _clear(scene, home, 8.6):
                scene.prisms.append(home)
            s += width + (0.0 if rng.uniform() < tall else rng.uniform(2, 14))


def _trees(scene: Scene, rng: np.random.Generator, side: int, spacing: float) -> None:
    """Trees behind the sidewalk, some at its edge, some far back: a trunk and a crown of overlapping ellipsoids."""
    for s in _along(scene, rng, 0.5 * spacing, 1.5 * spacing):
        d = side * rng.choice([rng.uniform(8.4, 9.2), rng.uniform(17, 28), rng.uniform(28, 70)], p=[0.5, 0.2, 0.3])
        point, _ = scene.street.place(s, d)
        height, spread, leaf = rng.uniform(5, 11), rng.uniform(1.5, 2.6), _pick(rng, LEAVES)
        trunk = solids.cylinder(point, rng.uniform(0.1, 0.24), 0.6 * height, "bark", solids.VEGETATION, (0.3, 0.24, 0.18), rng.uniform())
        if not _clear(scene, trunk, 8.2):
            continue
        scene.quadrics.append(trunk)
        for _ in range(rng.integers(7, 12)):
            offset = rng.normal(0, 0.45, 3).clip(-0.8, 0.8) * spread * np.array([1, 1.1, 1])
            radius = spread * rng.uniform(0.4, 0.72)
            centre = np.array([point[0], -0.72 * height, point[1]]) + offset
            radii = radius * np.array([1, rng.uniform(0.7, 1), 1])
            colour = tuple(np.array(leaf) * rng.uniform(0.8, 1.2))
            scene.quadrics.append(solids.ellipsoid(centre, radii, "leaves", solids.VEGETATION, colour, rng.uniform()))


def _hedges(scene: Scene, rng: np.random.Generator, side: int, density: float) -> None:
    """Hedges, garden fences and bushes between sidewalk and gardens."""
    for s in _along(scene, rng, 5.0, 9.0):
        place, kind, seed = scene.street.place(s, side * 8.75), rng.uniform(), rng.uniform()
        length, height, leaf = rng.uniform(4, 6.5), rng.uniform(0.8, 1.5), _pick(rng, LEAVES)
        if kind < 0.3:
            scene.prisms.append(solids.block(place, (length, 0.8, height), "hedge", solids.VEGETATION, leaf, seed))
        elif kind < 0.3 + 0.25 * density:
            scene.prisms.append(solids.block(place, (length, 0.08, height), "fence", solids.FENCE, _pick(rng, WALLS), seed))
        elif kind < 0.75:
            for _ in range(3):
                spot, _ = scene.street.place(s + rng.uniform(-2, 2), side * (9.3 + rng.uniform(-0.3, 1.0)))
                radius = rng.uniform(0.4, 0.9)
                shape = [1.1 * radius, radius, 1.1 * radius]
                scene.quadrics.append(
                    solids.ellipsoid([spot[0], -0.6 * radius, spot[1]], shape, "leaves", solids.VEGETATION, leaf, rng.uniform())
                )


def _poles(scene: Scene, rng: np.random.Generator, side: int) -> None:
    """Street lamps with an arm over the road, traffic signs, and bollards: slim things at the kerb."""
    for s in _along(scene, rng, 18.0, 30.0):
        point, _ = scene.street.place(s, side * 6.5)
        grey = _pick(rng, [(0.4, 0.42, 0.43), (0.25, 0.3, 0.27), (0.55, 0.55, 0.53)])
        scene.quadrics.append(solids.cylinder(point, rng.uniform(0.06, 0.11), 6.6, "metal", solids.POLE, grey, rng.uniform()))
        arm = scene.street.place(s, side * 5.7, np.pi / 2)
        scene.prisms.append(solids.block(arm, (1.7, 0.14, 0.12), "plain", solids.POLE, grey, 0.0, above=6.5))
    for s in _along(scene, rng, 14.0, 34.0):
        point, heading = scene.street.place(s, side * 6.7)
        scene.quadrics.append(solids.cylinder(point, 0.05, 2.9, "metal", solids.POLE, (0.5, 0.5, 0.5), rng.uniform()))
        colour = _pick(rng, [(0.75, 0.1, 0.1), (0.1, 0.25, 0.6), (0.85, 0.75, 0.2), (0.85, 0.85, 0.85)])
        front = scene.street.place(s - 0.07, side * 6.7)._replace(heading=heading)
        scene.prisms.append(solids.block(front, (0.03, 0.65, 0.65), "sign", solids.SIGN, colour, rng.uniform(), above=2.2))
    first = rng.uniform(0, 60)
    for s in np.arange(first, first + 12, 1.8):
        point, _ = scene.street.place(s, side * 6.45)
        scene.quadrics.append(solids.cylinder(point, 0.07, 1.0, "bollard", solids.POLE, (0.7, 0.68, 0.66), rng.uniform()))


def _parked(scene: Scene, rng: np.random.Generator, side: int, density: float) -> None:
    """Rows of parked cars on the strip between lane and kerb, with gaps."""
    busy = True
    for s in _along(scene, rng, 5.2, 7.5):
        busy = rng.uniform() < (0.85 if busy else 0.12)
        if busy and rng.uniform() < 0.35 + 0.5 * density:
            point, heading = scene.street.place(s, side * (5.0 + rng.uniform(-0.08, 0.08)), 0.0 if side > 0 else np.pi)
            place = Place(point, heading + rng.uniform(-0.02, 0.02))
            scene.prisms += solids.car(place, _pick(rng, PAINTS), rng.uniform())


def _hills(scene: Scene, rng: np.random.Generator) -> None:
    """Wooded hills beyond the street's end and sides, 180 to 450 m away: the horizon."""
    for _ in range(26):
        s, side = rng.uniform(scene.street.s[0], scene.street.s[-1] + 260), rng.choice([-1, 1])
        d = side * rng.uniform(150, 320) if s < scene.street.s[-1] else side * rng.uniform(0, 220)
        point, heading = scene.street.place(min(s, scene.street.s[-1]), d)
        point = point + max(0.0, s - scene.street.s[-1] + 60) * np.array([np.sin(heading), np.cos(heading)])
        radii = [rng.uniform(40, 80), rng.uniform(8, 22), rng.uniform(40, 80)]
        scene.quadrics.append(
            solids.ellipsoid([point[0], 0, point[1]], radii, "forest", solids.VEGETATION, (0.2, 0.28, 0.16), rng.uniform())
        )


def _mover(rng: np.random.Generator, k: int, plan: Plan) -> Mover:
    """Moving car number `k`: even ones come towards the camera, odd ones drive ahead of it, away from it."""
    paint, seed = _pick(rng, PAINTS), rng.uniform()
    if k % 2 == 0:
        return Mover(plan.length * rng.uniform(0.6, 1.1) + 60 * (k // 2) + 20, -rng.uniform(6, 11), -LANE, paint, seed)
    return Mover(rng.uniform(22, 40) + 45 * (k // 2), plan.pace * rng.uniform(1.15, 1.35), LANE, paint, seed)
