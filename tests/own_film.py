"""Films made on the spot: upright stripes at different depths, seen by a camera that moves sideways."""

from pathlib import Path

import cv2
import numpy as np
from small_kitti import wall

SIZE = (216, 256)
SPEEDS = (1, 5, 2, 4)
"""Pixels that the stripes move in each frame; as far as a car's street at 10 Hz."""
_CANVAS = {speed: wall(SIZE[0], 1600, seed=speed) for speed in SPEEDS}


def frame(place: float, seed: int = 0, speed: float = 1.0, size=SIZE) -> np.ndarray:
    """The frame (H, W, 3) uint8 RGB at a place on the way, in frames; another seed is another street."""
    width = SIZE[1] // len(SPEEDS)
    parts = []
    for k, of_stripe in enumerate(SPEEDS):
        left = 97 * seed + 30 * k + of_stripe * speed * place
        shift = np.array([[1, 0, -left], [0, 1, 0]], np.float32)
        parts.append(cv2.warpAffine(_CANVAS[of_stripe], shift, (width, SIZE[0]), flags=cv2.INTER_LINEAR))
    image = np.concatenate(parts, 1)
    image = np.roll(image[::-1], 40 * seed, 0) if seed else image
    return image if size == SIZE else cv2.resize(image, size[::-1])


def turning(angle: float, focal: float = 0.8 * SIZE[1]) -> np.ndarray:
    """A frame of a camera that turns on the spot by `angle` in radians."""
    matrix = np.array([[focal, 0, SIZE[1] / 2], [0, focal, SIZE[0] / 2], [0, 0, 1]])
    rotation = cv2.Rodrigues(np.array([0.0, angle, 0.0]))[0]
    far = wall(SIZE[0], SIZE[1], seed=9)
    return cv2.warpPerspective(far, matrix @ rotation @ np.linalg.inv(matrix), SIZE[::-1], borderMode=cv2.BORDER_REFLECT)


def write_frames(folder, frames, names=None, suffix=".png") -> Path:
    """Images of a folder, named by their numbers or by `names`."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    for name, image in zip(names or (f"{n:06d}" for n in range(len(frames))), frames):
        cv2.imwrite(str(folder / f"{name}{suffix}"), image[:, :, ::-1])
    return folder


def write_video(path, frames, code="mp4v", rate=10) -> Path:
    """A video file."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*code), rate, frames[0].shape[1::-1])
    for image in frames:
        writer.write(np.ascontiguousarray(image[:, :, ::-1]))
    writer.release()
    return Path(path)


def chessboards(matrix, distortion, size, corners=(9, 6), views=12, seed=0) -> list[np.ndarray]:
    """Views (H, W, 3) uint8 of a chessboard by a camera with OpenCV's distortion (k1, k2, p1, p2, k3), anti-aliased."""
    rng = np.random.default_rng(seed)
    rows, columns = np.mgrid[: 2 * size[0], : 2 * size[1]].astype(np.float64)
    pixels = np.stack([(columns.ravel() - 0.5) / 2, (rows.ravel() - 0.5) / 2], -1)
    rays = cv2.undistortPoints(pixels[:, None], matrix, np.array(distortion), criteria=(cv2.TERM_CRITERIA_COUNT, 40, 1e-9))[:, 0]
    rays = np.column_stack([rays, np.ones(len(rays))])
    images = []
    for _ in range(views):
        rotation = cv2.Rodrigues(np.append(rng.uniform(-0.6, 0.6, 2), rng.uniform(-0.3, 0.3)))[0]
        middle = np.array([(corners[0] - 1) / 2, (corners[1] - 1) / 2, 0])
        distance = rng.uniform(1.25, 1.6) * (corners[0] + 3) * matrix[0, 0] / size[1]
        centre = np.append(rng.uniform(-1.0, 1.0, 2), distance) - rotation @ middle
        normal = rotation[:, 2]
        depth = (normal @ centre) / (rays @ normal)
        board = (rays * depth[:, None] - centre) @ rotation
        x, y = board[:, 0] + 1, board[:, 1] + 1
        inside = (x > 0) & (x < corners[0] + 1) & (y > 0) & (y < corners[1] + 1)
        dark = inside & ((np.floor(x) + np.floor(y)) % 2 == 0)
        picture = np.where(dark, 20, 235).astype(np.uint8).reshape(2 * size[0], 2 * size[1])
        grey = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_AREA)
        images.append(np.repeat(grey[..., None], 3, 2))
    return images
