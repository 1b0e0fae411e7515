"""Files of camera poses as KITTI's odometry benchmark has them."""

from pathlib import Path
from typing import NamedTuple

import numpy as np

from dualdepth.atomic import write_text
from dualdepth.errors import InputError

FORMAT = "a KITTI pose file holds the 12 numbers of the 3x4 matrix [R|t] in a line, or 13 with the frame's number first"
TOLERANCE = 1e-3
"""How far R Rᵀ may be from the identity: six decimals and products of many float32 rotations pass."""
LIMIT = 1e9
"""Numbers from here on cannot be positions, whatever the unit, and would overflow later."""


class Trajectory(NamedTuple):
    """Camera poses of a sequence."""

    frames: np.ndarray
    """(N,) frame numbers, strictly increasing; those of a file without them are 0, 1, 2, …"""
    poses: np.ndarray
    """(N, 4, 4) float64, camera to world, metres."""
    indexed: bool
    """Whether the file gave the frame numbers."""


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a KITTI pose file: 12 numbers a line, or 13 with a leading frame number.

    Raises:
        InputError: naming the file and the line: missing, empty, another number of numbers, text, NaN, no rotation matrix, or frame
            numbers that are not increasing integers.
    """
    path = Path(path)
    if not path.is_file():
        raise InputError(f"{path}: no such file; {FORMAT}")
    try:
        text = path.read_text(encoding="utf-8-sig", errors="replace")
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror})") from None
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        raise InputError(f"{path}: empty; {FORMAT}")
    numbers = np.array([number for number, _ in lines])
    values = np.array([_row(words, len(lines[0][1]), f"{path}, line {number}") for number, words in lines])

    def refuse(bad: np.ndarray, what: str) -> None:
        if bad.any():
            raise InputError(f"{path}, line {numbers[bad.argmax()]}: {what}")

    refuse(~(np.abs(values) < LIMIT).all(1), f"NaN, infinite or beyond {LIMIT:g}; give finite numbers, positions in metres")
    indexed = values.shape[1] == 13
    if indexed:
        frames = values[:, 0]
        refuse((frames != np.round(frames)) | (frames < 0), "the frame number, the first of 13, is no integer from 0 up")
        refuse(np.diff(frames, prepend=-1) <= 0, "the frame number is not above the one before; sort the lines, one a frame")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    poses[:, :3] = values[:, -12:].reshape(-1, 3, 4)
    rotations = poses[:, :3, :3]
    orthonormal = np.abs(rotations @ rotations.mT - np.eye(3)).max((1, 2)) < TOLERANCE
    refuse(~orthonormal | (np.linalg.det(rotations) < 0), f"the left 3x4 columns are no rotation matrix; {FORMAT}")
    return Trajectory(values[:, 0].astype(np.int64) if indexed else np.arange(len(values)), poses, indexed)


def _row(words: list[str], width: int, where: str) -> list[float]:
    values = []
    for word in words:
        try:
            values.append(float(word))
        except ValueError:
            raise InputError(f"{where}: {word[:20]!r} is no number; {FORMAT}, with spaces between") from None
    if len(values) in (7, 8):
        raise InputError(
            f"{where}: {len(values)} numbers, which look like TUM's position and quaternion; give KITTI's 3x4 matrices: {FORMAT}"
        )
    if len(values) not in (12, 13):
        raise InputError(f"{where}: {len(values)} numbers; {FORMAT}")
    if len(values) != width:
        raise InputError(f"{where}: {len(values)} numbers, but the first line has {width}; give all lines the frame's number, or none")
    return values


def write_trajectory(path: str | Path, poses: np.ndarray, frames: np.ndarray | None = None) -> None:
    """Write poses as a KITTI pose file, atomically and without loss.

    Args:
        path: the file.
        poses: (N, 4, 4) or (N, 3, 4), camera to world, metres.
        frames: (N,) frame numbers, written first in each line; without them lines have 12 numbers.

    Raises:
        InputError: the numbers of frames and poses differ, or the file cannot be written.
    """
    if frames is not None and len(frames) != len(poses):
        raise InputError(f"{path}: {len(frames)} frame numbers but {len(poses)} poses; give one for each")
    rows = [" ".join(f"{value:.17g}" for value in np.asarray(pose, np.float64)[:3].ravel()) for pose in poses]
    if frames is not None:
        rows = [f"{int(frame)} {row}" for frame, row in zip(frames, rows)]
    try:
        write_text(path, "".join(f"{row}\n" for row in rows))
    except OSError as error:
        raise InputError(f"{path}: cannot write the poses ({error.strerror})") from None


def paired(
    prediction: Trajectory, truth: Trajectory, names: tuple[str, str] = ("the prediction", "the ground truth")
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frames that both trajectories have, and their poses in each.

    A prediction with frame numbers is matched by them; one without has a pose for each of the ground truth's, in order.

    Args:
        prediction: what is scored.
        truth: what it is compared with; without frame numbers its first pose is frame 0's.
        names: of the two, for messages: their files.

    Returns:
        (M,) frame numbers, (M, 4, 4) predicted and (M, 4, 4) true poses.

    Raises:
        InputError: the lengths differ and the prediction has no frame numbers, or no frame is in both.
    """
    ours, theirs = names
    if not prediction.indexed:
        if len(prediction.poses) != len(truth.poses):
            raise InputError(
                f"{ours} has {len(prediction.poses)} poses but {theirs} has {len(truth.poses)}; give one for each frame, or put the frame's"
                " number first in each line"
            )
        return truth.frames, prediction.poses, truth.poses
    frames, at, true_at = np.intersect1d(prediction.frames, truth.frames, assume_unique=True, return_indices=True)
    if not len(frames):
        spans = [f"{t.frames[0]} to {t.frames[-1]}" for t in (prediction, truth)]
        raise InputError(f"{ours} has frames {spans[0]} and {theirs} {spans[1]}: none in common; are they of the same sequence?")
    return frames, prediction.poses[at], truth.poses[true_at]
