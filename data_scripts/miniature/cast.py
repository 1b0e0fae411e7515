"""Exact ray casting against ground, prisms and quadrics, with numpy.

A ray goes through the point (x, y, 1) of its camera frame (x right, y down, z forward). Everything is done in
*nearness*, 1 / camera-z depth: the nearness of a plane is affine in (x, y), so a prism costs one multiply-add a face
and ray. Each solid is tested only against the rays inside the rectangle that its bounding box covers.
"""

from typing import NamedTuple

import numpy as np

from data_scripts.miniature.solids import Prism, Quadric, Solid, Surface

SKY, GROUND, FIRST = 0, 1, 2  # Indices of a hit; surfaces are numbered from `FIRST` in the order of `surfaces`.
NEAR = 0.2  # Boxes are cut at this camera-z (metres) before they are projected.


class Rays(NamedTuple):
    """A fan of rays from one point."""

    pose: np.ndarray  # (4, 4) camera to world.
    x: np.ndarray  # (1, W) float32, rising.
    y: np.ndarray  # (H, 1), rising, or (H, W); float32.


class Hits(NamedTuple):
    """What the rays meet first."""

    nearness: np.ndarray  # (H, W) float32, 1 / camera-z depth in 1/m; 0 in the sky.
    index: np.ndarray  # (H, W) uint16.


def surfaces(shapes: list[Solid]) -> list[tuple[Solid, Surface]]:
    """The solid and surface of each index from `FIRST` on."""
    return [(shape, surface) for shape in shapes for surface in shape.surfaces]


def cast(shapes: list[Solid], rays: Rays) -> Hits:
    """Find the first hit of each ray."""
    rotation, origin = rays.pose[:3, :3], rays.pose[:3, 3]
    ground = _affine(rotation[1] / -origin[1], rays.x, rays.y)
    nearness = np.maximum(ground, 0.0).astype(np.float32)
    index = np.where(ground > 0, np.uint16(GROUND), np.uint16(SKY))
    first = FIRST + np.cumsum([0, *(len(shape.surfaces) for shape in shapes[:-1])])
    windows, nearest = _windows(shapes, rays)
    for k in np.argsort(-nearest, kind="stable"):  # front to back, since what is hidden as a whole costs nothing more
        rows, columns = windows[k]
        part = Hits(nearness[rows, columns], index[rows, columns])
        if part.nearness.min(initial=np.inf) >= nearest[k]:
            continue
        y = rays.y[rows] if rays.y.shape[1] == 1 else rays.y[rows, columns]
        add = _cast_prism if isinstance(shapes[k], Prism) else _cast_quadric
        add(shapes[k], first[k], rotation, origin, rays.x[:, columns], y, part)
    return Hits(nearness, index)


def _affine(form: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """form · (x, y, 1) for all rays; the two vectors are summed first, so that it costs one addition a ray."""
    a, b, c = form.astype(np.float32)
    return a * x + (b * y + c)


def _windows(shapes: list[Solid], rays: Rays) -> tuple[list[tuple[slice, slice]], np.ndarray]:
    """Rows and columns of the rays that may meet each solid's box; and the boxes' greatest nearness."""
    corners = np.stack([shape.corners for shape in shapes]) - rays.pose[:3, 3]
    corners = corners @ rays.pose[:3, :3]  # (N, 8, 3) in the camera frame
    i, j = np.triu_indices(8, 1)
    p, q = corners[:, i], corners[:, j]
    with np.errstate(divide="ignore", invalid="ignore"):
        cut = p + (q - p) * ((NEAR - p[..., 2:]) / (q[..., 2:] - p[..., 2:]))
    crosses = (p[..., 2] < NEAR) != (q[..., 2] < NEAR)
    points = np.concatenate([corners, cut], 1)
    there = np.concatenate([corners[..., 2] >= NEAR, crosses], 1)
    with np.errstate(divide="ignore", invalid="ignore"):
        flat = points[..., :2] / points[..., 2:]
    low = np.where(there[..., None], flat, np.inf).min(1)
    high = np.where(there[..., None], flat, -np.inf).max(1)
    left, right = np.searchsorted(rays.x[0], low[:, 0]), np.searchsorted(rays.x[0], high[:, 0], "right")
    if rays.y.shape[1] == 1:
        top, bottom = np.searchsorted(rays.y[:, 0], low[:, 1]), np.searchsorted(rays.y[:, 0], high[:, 1], "right")
    else:
        top, bottom = np.zeros(len(shapes), int), np.full(len(shapes), rays.y.shape[0])
    boxes = zip(top, bottom, left, right)
    depth = corners[..., 2].min(1)
    nearest = np.where(depth > NEAR, 1 / np.maximum(depth, NEAR), np.inf)
    return [(slice(t, b), slice(lo, hi)) for t, b, lo, hi in boxes], nearest


def _cast_prism(shape: Prism, first: int, rotation, origin, x, y, part: Hits) -> None:
    """Enter the prism's hits into `part`: a ray is inside between the last front face it enters and the first back face."""
    distance = shape.offsets - shape.normals @ origin
    forms = (shape.normals @ rotation) / np.where(distance == 0, 1e-9, distance)[:, None]
    front = np.flatnonzero(distance < 0)
    if not front.size:
        return
    nearness = _affine(forms[front[0]], x, y)
    index = np.uint16(first + front[0])
    for face in front[1:]:
        other = _affine(forms[face], x, y)
        index = np.where(other < nearness, np.uint16(first + face), index)
        np.minimum(nearness, other, out=nearness)
    hit = nearness > part.nearness
    for face in np.flatnonzero(distance >= 0):
        if not hit.any():
            return
        hit &= nearness > _affine(forms[face], x, y)
    np.copyto(part.nearness, nearness, where=hit)
    np.copyto(part.index, index, where=hit)


def _cast_quadric(shape: Quadric, first: int, rotation, origin, x, y, part: Hits) -> None:
    """Enter the quadric's hits into `part`: with nearness w, C w² + 2 B w + A = 0, the larger root comes first."""
    gain = 1 / shape.radii**2
    offset = origin - shape.centre
    constant = gain @ offset**2 - 1
    if constant <= 0:
        return
    linear = (gain * offset) @ rotation
    # The discriminant is a difference of large terms far away, so it is expanded around the window's middle.
    middle = np.array([[1, 0, x.mean()], [0, 1, y.mean()], [0, 0, 1]], float)
    form = middle.T @ (np.outer(linear, linear) - constant * (rotation.T * gain) @ rotation) @ middle
    x0, y0 = (x - middle[0, 2]).astype(np.float32), (y - middle[1, 2]).astype(np.float32)
    (a, b, c), (_, d, e), (_, _, f) = form.astype(np.float32)
    square = (a * x0 + 2 * c) * x0 + ((d * y0 + 2 * e) * y0 + f) + (2 * b * y0) * x0
    ahead = _affine(-linear / constant, x, y)
    hit = (square > 0) & (ahead > 0)
    if not hit.any():
        return
    nearness = ahead + np.sqrt(np.maximum(square, 0)) * np.float32(1 / constant)
    hit &= nearness > part.nearness
    if np.isfinite(shape.top):
        hit &= _affine(rotation[1], x, y) >= np.float32(shape.top - origin[1]) * nearness
    np.copyto(part.nearness, nearness, where=hit)
    np.copyto(part.index, np.uint16(first), where=hit)
