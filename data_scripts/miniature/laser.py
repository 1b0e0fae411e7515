"""A simulated 64-beam laser scanner in the same world, cast from its own position, so with its own occlusions."""

import numpy as np

from data_scripts.miniature.cast import Rays, cast, surface_table
from data_scripts.miniature.colours import shade
from data_scripts.miniature.scene import Scene

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
    hits = cast(shapes, rays)
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
