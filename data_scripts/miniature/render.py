"""Views of a scene: image, exact depth, labels, and what moves; and laser scans of the same world.

Pixel (0, 0) is the centre of the first pixel: u = fx X / Z + cx.
"""

from typing import NamedTuple

import cv2
import numpy as np

from data_scripts.miniature.cast import FIRST, GROUND, Hits, Rays, cast, surface_table
from data_scripts.miniature.colours import CHUNK, shade
from data_scripts.miniature.ground import ground_label
from data_scripts.miniature.scene import Scene
from data_scripts.miniature.solids import SKY, Prism


class View(NamedTuple):
    """One rendered frame of (H, W) pixels."""

    image: np.ndarray
    """(H, W, 3) uint8 RGB, the mean over `supersample`² rays a pixel."""
    depth: np.ndarray
    """(H, W) float32, exact camera-z depth at the pixels' centres in metres; 0 in the sky."""
    labels: np.ndarray
    """(H, W) uint8, Cityscapes' training ids at the pixels' centres."""
    moving: np.ndarray
    """(H, W) bool, at the pixels' centres."""


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


def render_image(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], supersample: int, time: float) -> np.ndarray:
    """Only the image of `render`, (H, W, 3) uint8."""
    shapes = scene.shapes(time)
    rays = camera_rays(pose, intrinsics, size, supersample)
    colour = shade(scene, surface_table(shapes), rays, cast(shapes, rays))
    mean = [cv2.resize(channel, size[::-1], interpolation=cv2.INTER_AREA) for channel in colour]
    return (np.stack(mean, -1) * 255 + 0.5).astype(np.uint8)


def render_geometry(scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], time: float) -> tuple[np.ndarray, ...]:
    """Depth, labels and moving pixels of `render`."""
    shapes = scene.shapes(time)
    rays = camera_rays(pose, intrinsics, size)
    hits = cast(shapes, rays)
    surfaces = [s for shape in shapes for s in (shape.surfaces if isinstance(shape, Prism) else [shape.surface])]
    labels = np.array([SKY, 0] + [s.label for s in surfaces], np.uint8)[hits.index]
    moving = np.array([False] * FIRST + [s.moving for s in surfaces])[hits.index]
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


BEAMS = np.radians(np.concatenate([2 - np.arange(32) / 3, -8.83 - np.arange(32) * (24.8 - 8.83) / 31]))
"""Elevations of a 64-beam scanner as KITTI's: two blocks from +2 to -24.8 degrees."""
AZIMUTH_REACH = 50.0
"""Only the part of the scan in front is cast, to both sides in degrees; the cameras see 41."""
LASER_RANGE = 120.0
NOISE, LOSS = 0.01, 0.04
"""Deviation of the measured distance in metres, and share of returns that are lost."""


def laser_scan(scene: Scene, pose: np.ndarray, laser_to_camera: np.ndarray, time: float, azimuth_step: float, seed: tuple) -> np.ndarray:
    """Scan the scene from the laser's own position.

    Args:
        scene: from `build_scene`.
        pose: (4, 4) of the rectified camera, camera to world.
        laser_to_camera: (4, 4) from the laser's frame (x forward, y left, z up) to the camera's.
        time: seconds.
        azimuth_step: degrees between firings.
        seed: of noise and lost returns.

    Returns:
        (N, 4) float32: x, y, z in the laser's frame in metres, reflectance in 0..1.
    """
    azimuth = np.radians(np.arange(-AZIMUTH_REACH, AZIMUTH_REACH, azimuth_step))  # positive to the right
    x = np.tan(azimuth)[None]
    y = -np.tan(BEAMS)[:, None] / np.cos(azimuth)[None]
    from_camera_axes = np.array([[0.0, 0, 1, 0], [-1, 0, 0, 0], [0, -1, 0, 0], [0, 0, 0, 1]])
    rays = Rays(pose @ laser_to_camera @ from_camera_axes, x.astype(np.float32), y.astype(np.float32))
    shapes = scene.shapes(time)
    hits: Hits = cast(shapes, rays)
    reflectance = shade(scene, surface_table(shapes), rays, hits).mean(0)
    rng = np.random.default_rng(seed)
    with np.errstate(divide="ignore"):
        depth = 1 / hits.nearness
    stretch = np.sqrt(1 + x**2 + y**2)
    keep = (depth * stretch < LASER_RANGE) & (rng.uniform(size=depth.shape) > LOSS)
    depth = depth + rng.normal(0, NOISE, depth.shape) / stretch
    x, y = np.broadcast_to(x, keep.shape)[keep], y[keep]
    depth = depth[keep]
    return np.stack([depth, -x * depth, -y * depth, reflectance[keep]], -1).astype(np.float32)
