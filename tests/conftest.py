"""A tiny KITTI-like root made on the spot: a textured wall seen by a camera that moves sideways."""

import os
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch is loaded: spinning threads slow a busy machine tenfold

import cv2
import numpy as np
import pytest

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


@pytest.fixture
def kitti_root(tmp_path):
    """Root with one drive of five PNG frames of 208×208, and calibration."""
    root = tmp_path / "kitti"
    write_calibration(root)
    write_drive(root, range(5))
    return root


@pytest.fixture
def kitti_factory(tmp_path):
    """Makes a root with drives and their frame numbers, and the calibration of a laser that looks along the camera."""

    def make(drives):
        root = tmp_path / "kitti"
        write_calibration(root)
        camera = root / "2011_09_26" / "calib_cam_to_cam.txt"
        camera.write_text(camera.read_text() + "R_rect_00: 1 0 0 0 1 0 0 0 1\nS_rect_02: 208 208\n")
        (root / "2011_09_26" / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.27\n")
        for drive, frames in drives.items():
            write_drive(root, frames, drive)
        return root

    return make


@pytest.fixture
def write_scan():
    """Writes a scan of a wall 12 m ahead for a frame."""

    def write(root, drive, index):
        path = Path(root) / drive / "velodyne_points" / "data" / f"{index:010d}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        left, up = np.meshgrid(np.linspace(-5, 5, 40), np.linspace(-5, 5, 40))
        np.stack([np.full(left.size, 12.0), left.ravel(), up.ravel(), np.ones(left.size)], 1).astype(np.float32).tofile(path)

    return write
