"""How the car with the camera moves: poses along a street's right-hand lane, with the small motions of a real car."""

from typing import NamedTuple

import numpy as np

from data_scripts.miniature.scene import LANE
from data_scripts.miniature.street import Plan, Street

PERIOD = 0.1  # Seconds between frames, as KITTI's 10 Hz.
CAMERA_HEIGHT = 1.65
START = 3.0  # The drive begins at this street coordinate, metres.


class Drive(NamedTuple):
    """A recorded drive."""

    plan: Plan
    poses: np.ndarray  # (N, 4, 4) camera to world.
    standing: np.ndarray  # (N,) bool: the camera stands where it stood a frame before or stands a frame later.

    @property
    def times(self) -> np.ndarray:
        """(N,) seconds."""
        return np.arange(len(self.poses)) * PERIOD


def camera_pose(street: Street, s: float, d: float, height: float, angles: tuple[float, float, float]) -> np.ndarray:
    """(4, 4) camera to world, at street coordinates `s`, `d`; `angles` are yaw to the right of the road, pitch up, roll, in radians."""
    point, heading = street.place(s, d)
    yaw, pitch, roll = angles[0] + heading, angles[1], angles[2]
    turn = np.array([[np.cos(yaw), 0, np.sin(yaw)], [0, 1, 0], [-np.sin(yaw), 0, np.cos(yaw)]])
    nod = np.array([[1, 0, 0], [0, np.cos(pitch), -np.sin(pitch)], [0, np.sin(pitch), np.cos(pitch)]])
    tilt = np.array([[np.cos(roll), -np.sin(roll), 0], [np.sin(roll), np.cos(roll), 0], [0, 0, 1]])
    pose = np.eye(4)
    pose[:3, :3] = turn @ nod @ tilt
    pose[:3, 3] = point[0], -height, point[1]
    return pose


def drive(plan: Plan, street: Street, spacing: float, frames: int = 0, path: float = 0.0, still: tuple[int, int] = (0, 0)) -> Drive:
    """Drive along a street.

    The speed wavers by a quarter and falls in bends. All small motions are functions of the place, so a standing
    camera stands exactly.

    Args:
        plan, street: the street.
        spacing: mean metres between frames.
        frames: number of frames; 0 to go on until the path is longer than `path` metres.
        path: see `frames`.
        still: first frame and length of a stretch in which the camera does not move.
    """
    rng = np.random.default_rng((*plan.seed, 2))
    phases = rng.uniform(0, 2 * np.pi, (6, 3))
    poses, places = [], []
    s, gone = START, 0.0
    while len(poses) < frames or (not frames and gone <= path):
        wander, yaw, pitch, roll, bounce, speed = np.sin(s * 2 * np.pi / np.array([31.0, 11.0, 4.3]) + phases) @ np.array([0.6, 0.3, 0.2])
        angles = (np.radians(0.5) * yaw, np.radians(0.35) * pitch, np.radians(0.3) * roll)
        pose = camera_pose(street, s, LANE + 0.12 * wander, CAMERA_HEIGHT + 0.015 * bounce, angles)
        gone += float(np.linalg.norm(pose[:3, 3] - poses[-1][:3, 3])) if poses else 0.0
        poses.append(pose)
        places.append(s)
        if not still[0] <= len(poses) - 1 < still[0] + still[1] - 1:
            bend = min(abs(float(street.curvature(s))) / 0.03, 1.0)
            s += spacing * (1 + 0.25 * speed) * (1 - 0.25 * bend)
    standing = np.diff(places) == 0
    return Drive(plan, np.stack(poses), np.append(standing, False) | np.append(False, standing))
