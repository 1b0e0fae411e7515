"""A tiny KITTI-like root made on the spot: a textured wall seen by a camera that moves sideways."""

from pathlib import Path

import cv2
import numpy as np

from dualdepth.data.triplets import drive_triplets, load_triplets, raw_triplets, write_triplets

DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
SHIFT = 6
"""Pixels that the wall moves to the left in each frame."""


def wall(height, width, seed=0):
    """Smooth random texture (H, W, 3) uint8, with detail at several sizes."""
    rng = np.random.default_rng(seed)
    octaves = [
        cv2.resize(rng.random((max(height // s, 2), max(width // s, 2), 3)), (width, height)) / k for k, s in enumerate((32, 16, 8), 1)
    ]
    texture = sum(octaves)
    return np.rint(255 * (texture - texture.min()) / np.ptp(texture)).astype(np.uint8)


def write_calibration(root, date="2011_09_26", focal=220.0, centre=(104.0, 104.0)):
    """`calib_cam_to_cam.txt` with equal P_rect for the four cameras."""
    numbers = [focal, 0, centre[0], 0, 0, focal, centre[1], 0, 0, 0, 1, 0]
    lines = ["calib_time: 09-Jan-2012 13:57:47", *(f"P_rect_0{c}: {' '.join(f'{n:e}' for n in numbers)}" for c in range(4))]
    path = Path(root) / date / "calib_cam_to_cam.txt"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("\n".join(lines) + "\n")


def write_drive(root, frames, drive=DRIVE, size=(208, 208), camera="image_02", suffix=".png"):
    """Frames with the given numbers; frame i shows the wall moved by i · SHIFT pixels."""
    folder = Path(root) / drive / camera / "data"
    folder.mkdir(parents=True, exist_ok=True)
    canvas = wall(size[0], size[1] + SHIFT * (max(frames) + 1))
    for i in frames:
        cv2.imwrite(str(folder / f"{i:010d}{suffix}"), canvas[:, SHIFT * i : SHIFT * i + size[1], ::-1])


def write_sequence(root, name, frames, camera="image_2", size=(208, 208), calibration="calib.txt"):
    """An odometry sequence with the given frame numbers, its calibration, and true poses that go a metre a frame sideways."""
    folder = Path(root) / "sequences" / name
    (folder / camera).mkdir(parents=True, exist_ok=True)
    canvas = wall(size[0], size[1] + SHIFT * (max(frames) + 1), seed=int(name))
    for i in frames:
        cv2.imwrite(str(folder / camera / f"{i:06d}.png"), canvas[:, SHIFT * i : SHIFT * i + size[1], ::-1])
    numbers = "220 0 104 0 0 221 103 0 0 0 1 0"
    named = calibration == "calib.txt"
    (folder / calibration).write_text("".join(f"{f'P{k}: ' if named else ''}{numbers}\n" for k in range(4 if named else 2)))
    poses = Path(root) / "poses" / f"{name}.txt"
    poses.parent.mkdir(exist_ok=True)
    poses.write_text("".join(f"1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in range(max(frames) + 1)))


def triplets_of(root, folder):
    """The triplets of `DRIVE`, prepared in a folder."""
    path = Path(folder) / "triplets.csv"
    write_triplets(path, root, raw_triplets(root, drive_triplets(root, [DRIVE])))
    return load_triplets(path, root)
