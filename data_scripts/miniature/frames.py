"""One unit of work: render what belongs to one moment of a street and write its files."""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from data_scripts.miniature.formats import LASER_TO_CAMERA, laser_grid_bytes
from data_scripts.miniature.laser import laser_scan
from data_scripts.miniature.render import camera_rays, render_geometry, render_image
from data_scripts.miniature.scene import Scene, build_scene
from data_scripts.miniature.street import Plan

GRID = (55, 305)
"""Rows and columns of Make3D's laser grids, evenly over the whole photo."""
JPEG_QUALITY = 92


class Shot(NamedTuple):
    """One moment, and the files to write of it; those that are None are not made."""

    plan: Plan
    pose: np.ndarray
    """(4, 4) camera to world."""
    time: float
    """Seconds."""
    intrinsics: np.ndarray
    size: tuple[int, int]
    supersample: int
    image: Path
    """`.png` or `.jpg`."""
    depth: Path | None = None
    """`.npy`, exact camera-z depth in metres, 0 in the sky."""
    labels: Path | None = None
    scan: Path | None = None
    """`.bin`, the laser's points."""
    azimuth_step: float = 0.35
    grid: Path | None = None
    """`.mat`, Make3D's laser grid."""


@lru_cache(maxsize=2)
def _scene(plan: Plan) -> Scene:
    return build_scene(plan)


def write_shot(shot: Shot) -> None:
    """Render a shot and write its files."""
    for path in filter(None, (shot.image, shot.depth, shot.labels, shot.scan, shot.grid)):
        path.parent.mkdir(parents=True, exist_ok=True)
    scene = _scene(shot.plan)
    image = render_image(scene, shot.pose, shot.intrinsics, shot.size, shot.supersample, shot.time)
    _write_picture(shot.image, image[..., ::-1])
    if shot.depth and shot.labels:
        depth, labels, _ = render_geometry(scene, shot.pose, shot.intrinsics, shot.size, shot.time)
        np.save(shot.depth, depth)
        _write_picture(shot.labels, labels)
    if shot.scan:
        seed = (*shot.plan.seed, int(shot.scan.stem))
        laser_scan(scene, shot.pose, LASER_TO_CAMERA, shot.time, shot.azimuth_step, seed).tofile(shot.scan)
    if shot.grid:
        matrix = grid_intrinsics(shot.intrinsics, shot.size)
        depth, _, _ = render_geometry(scene, shot.pose, matrix, GRID, shot.time)
        rays = camera_rays(shot.pose, matrix, GRID)
        shot.grid.write_bytes(laser_grid_bytes(depth, rays.x, rays.y))


def grid_intrinsics(intrinsics: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics of a picture of `size` = (H, W) when it is divided into the cells of the laser grid."""
    scale = np.array([GRID[1] / size[1], GRID[0] / size[0], 1.0])
    matrix = intrinsics * scale[:, None]
    matrix[:2, 2] += (scale[:2] - 1) / 2  # (0, 0) is a centre, of the first pixel there and of the first cell here
    return matrix


def _write_picture(path: Path, picture: np.ndarray) -> None:
    """Write (H, W) or BGR (H, W, 3) uint8 as PNG or JPEG; unlike OpenCV's writer this raises on a full disk."""
    options = [cv2.IMWRITE_PNG_COMPRESSION, 3] if path.suffix == ".png" else [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    path.write_bytes(cv2.imencode(path.suffix, picture, options)[1].tobytes())
