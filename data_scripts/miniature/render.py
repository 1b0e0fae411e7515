"""Views of a scene: image, exact depth, labels, and what moves.

Pixel (0, 0) is the centre of the first pixel: u = fx X / Z + cx.
"""

from typing import NamedTuple

import cv2
import numpy as np

from data_scripts.miniature.cast import FIRST, GROUND, Rays, cast, surface_table
from data_scripts.miniature.colours import CHUNK, shade
from data_scripts.miniature.ground import ground_label
from data_scripts.miniature.scene import Scene
from data_scripts.miniature.solids import SKY


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


def render_image(
    scene: Scene, pose: np.ndarray, intrinsics: np.ndarray, size: tuple[int, int], supersample: int, time: float
) -> np.ndarray:
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
    surfaces = [surface for shape in shapes for surface in shape.surfaces]
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
