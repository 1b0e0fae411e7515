"""Views of a scene: image, exact depth, labels, what moves, the scan of a laser; and the files that a moment's views become.

Pixel (0, 0) is the centre of the first pixel: u = fx X / Z + cx.
"""

from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from data_scripts.miniature.cast import FIRST, GROUND, Rays, cast, surfaces
from data_scripts.miniature.colours import CHUNK, shade
from data_scripts.miniature.formats import LASER_TO_CAMERA, laser_grid_bytes
from data_scripts.miniature.ground import ground_label
from data_scripts.miniature.scene import Scene, build_scene
from data_scripts.miniature.solids import SKY
from data_scripts.miniature.street import Plan

BEAMS = np.radians(np.concatenate([2 - np.arange(32) / 3, -8.83 - np.arange(32) * (24.8 - 8.83) / 31]))
"""Elevations of a 64-beam scanner as KITTI's: two blocks from +2 to -24.8 degrees."""
AZIMUTH_REACH = 50.0  # Only the part of the scan in front is cast, to both sides in degrees; the cameras see 41.
LASER_RANGE = 120.0
NOISE, LOSS = 0.01, 0.04  # Deviation of the measured distance in metres, and share of returns that are lost.
GRID = (55, 305)  # Rows and columns of Make3D's laser grids, evenly over the whole photo.
JPEG_QUALITY = 92


class View(NamedTuple):
    """One rendered frame of (H, W) pixels."""

    image: np.ndarray  # (H, W, 3) uint8 RGB, the mean over `supersample`² rays a pixel.
    depth: np.ndarray  # (H, W) float32, exact camera-z depth at the pixels' centres in metres; 0 in the sky.
    labels: np.ndarray  # (H, W) uint8, Cityscapes' training ids at the pixels' centres.
    moving: np.ndarray  # (H, W) bool, at the pixels' centres.


def camera_rays(pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], supersample: int = 1) -> Rays:
    """Rays of a pinhole camera, `supersample` per pixel side, evenly over each pixel's area.

    Args:
        pose: (4, 4) camera to world.
        intrinsics: (3, 3) in pixels.
        size: (H, W).
        supersample: 1 gives the pixels' centres.
    """
    v, u = ((np.arange(n * supersample) + 0.5) / supersample - 0.5 for n in size)
    x, y = (u - intrinsics[0, 2]) / intrinsics[0, 0], (v - intrinsics[1, 2]) / intrinsics[1, 1]
    return Rays(pose, x.astype(np.float32)[None], y.astype(np.float32)[:, None])


def render_image(
    scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], supersample: int, time: float
) -> np.ndarray:
    """Only the image of `render`, (H, W, 3) uint8."""
    shapes, rays = scene.shapes(time), camera_rays(pose, intrinsics, size, supersample)
    colour = shade(scene, shapes, rays, cast(shapes, rays))
    mean = [cv2.resize(channel, size[::-1], interpolation=cv2.INTER_AREA) for channel in colour]
    return (np.stack(mean, -1) * 255 + 0.5).astype(np.uint8)


def render_geometry(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], time: float) -> tuple[np.ndarray, ...]:
    """Depth, labels and moving pixels of `render`."""
    shapes, rays = scene.shapes(time), camera_rays(pose, intrinsics, size)
    hits, faces = cast(shapes, rays), [surface for _, surface in surfaces(shapes)]
    labels = np.array([SKY, 0] + [face.label for face in faces], np.uint8)[hits.index]
    moving = np.array([False] * FIRST + [face.moving for face in faces])[hits.index]
    with np.errstate(divide="ignore"):
        depth = np.where(hits.nearness > 0, 1 / hits.nearness, 0).astype(np.float32)
    rows, columns = np.nonzero(hits.index == GROUND)
    for low in range(0, rows.size, CHUNK):
        r, c = rows[low : low + CHUNK], columns[low : low + CHUNK]
        points = pose[:3, :3] @ np.stack([rays.x[0, c], rays.y[r, 0], np.ones(r.size)]) * depth[r, c] + pose[:3, 3:]
        labels[r, c] = ground_label(scene.street, points[0], points[2])
    return depth, labels, moving


def render(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], supersample: int = 3, time: float = 0.0) -> View:
    """Render one frame.

    Args:
        scene: from `build_scene`.
        pose: (4, 4) camera to world.
        intrinsics: (3, 3) in pixels.
        size: (H, W).
        supersample: rays per pixel side.
        time: seconds; moves the moving cars.
    """
    image = render_image(scene, pose, intrinsics, size, supersample, time)
    return View(image, *render_geometry(scene, pose, intrinsics, size, time))


def laser_scan(scene: Scene, pose: np.ndarray, time: float, azimuth_step: float, seed: tuple) -> np.ndarray:
    """Simulate a 64-beam laser scanner, cast from its own position, so with its own occlusions.

    Args:
        scene: from `build_scene`.
        pose: (4, 4) of the rectified camera, camera to world.
        time: seconds.
        azimuth_step: degrees between firings.
        seed: of noise and lost returns.

    Returns:
        (N, 4) float32: x, y, z in the laser's frame (forward, left, up) in metres, reflectance in 0..1.
    """
    azimuth = np.radians(np.arange(-AZIMUTH_REACH, AZIMUTH_REACH, azimuth_step))  # positive to the right
    x = np.tan(azimuth)[None]
    y = -np.tan(BEAMS)[:, None] / np.cos(azimuth)[None]
    from_camera_axes = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    rays = Rays(pose @ LASER_TO_CAMERA @ from_camera_axes, x.astype(np.float32), y.astype(np.float32))
    shapes = scene.shapes(time)
    hits = cast(shapes, rays)
    reflectance = shade(scene, shapes, rays, hits).mean(0)
    rng = np.random.default_rng(seed)
    with np.errstate(divide="ignore"):
        depth = 1 / hits.nearness
    stretch = np.sqrt(1 + x**2 + y**2)
    keep = (depth * stretch < LASER_RANGE) & (rng.uniform(size=depth.shape) > LOSS)
    depth = depth + rng.normal(0, NOISE, depth.shape) / stretch
    x, y = np.broadcast_to(x, keep.shape)[keep], y[keep]
    depth = depth[keep]
    return np.stack([depth, -x * depth, -y * depth, reflectance[keep]], -1).astype(np.float32)


class Shot(NamedTuple):
    """One moment, and the files to write of it; those that are None are not made."""

    plan: Plan
    pose: np.ndarray  # (4, 4) camera to world.
    time: float  # Seconds.
    intrinsics: np.ndarray
    size: tuple[int, int]
    supersample: int
    image: Path  # `.png` or `.jpg`.
    depth: Path | None = None  # `.npy`, exact camera-z depth in metres, 0 in the sky.
    labels: Path | None = None
    scan: Path | None = None  # `.bin`, the laser's points.
    azimuth_step: float = 0.35
    grid: Path | None = None  # `.mat`, Make3D's laser grid.


_scene = lru_cache(maxsize=2)(build_scene)


def write_shot(shot: Shot) -> None:
    """Render a shot and write its files."""
    for path in filter(None, (shot.image, shot.depth, shot.labels, shot.scan, shot.grid)):
        path.parent.mkdir(parents=True, exist_ok=True)
    scene, view = _scene(shot.plan), (shot.pose, shot.intrinsics, shot.size)
    _write_picture(shot.image, render_image(scene, *view, shot.supersample, shot.time)[..., ::-1])
    if shot.depth and shot.labels:
        depth, labels, _ = render_geometry(scene, *view, shot.time)
        np.save(shot.depth, depth)
        _write_picture(shot.labels, labels)
    if shot.scan:
        seed = (*shot.plan.seed, int(shot.scan.stem))
        laser_scan(scene, shot.pose, shot.time, shot.azimuth_step, seed).tofile(shot.scan)
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
