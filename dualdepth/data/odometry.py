"""KITTI odometry on disk: sequences, their calibration and true poses, the triplets to train on, and files of camera poses.

Layout, as KITTI unpacks: `ROOT/sequences/00/image_2/000000.png` (or .jpg), `ROOT/sequences/00/calib.txt`, `ROOT/poses/00.txt`.
"""

import functools
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np

from dualdepth.data.kitti import SUFFIXES, calibration_entry, check_root, read_calibration
from dualdepth.data.triplets import Triplet
from dualdepth.errors import InputError, reading
from dualdepth.files import write_text

RAW_DRIVES = {
    "00": "2011_10_03/2011_10_03_drive_0027_sync",
    "01": "2011_10_03/2011_10_03_drive_0042_sync",
    "02": "2011_10_03/2011_10_03_drive_0034_sync",
    "03": "2011_09_26/2011_09_26_drive_0067_sync",
    "04": "2011_09_30/2011_09_30_drive_0016_sync",
    "05": "2011_09_30/2011_09_30_drive_0018_sync",
    "06": "2011_09_30/2011_09_30_drive_0020_sync",
    "07": "2011_09_30/2011_09_30_drive_0027_sync",
    "08": "2011_09_30/2011_09_30_drive_0028_sync",
    "09": "2011_09_30/2011_09_30_drive_0033_sync",
    "10": "2011_09_30/2011_09_30_drive_0034_sync",
}
"""The raw drive that each sequence was cut from (KITTI's odometry development kit)."""
CAMERA = "image_2"  # The left colour camera, as in the paper.
check_odometry_root = functools.partial(
    check_root, option="ODOMETRY_ROOT", pattern="sequences/[0-9][0-9]", mend="give the folder that holds `sequences` and `poses`"
)


def sequence_of(entry: str) -> tuple[str, str]:
    """(sequence, camera folder) of an entry like `00` or `06:image_0`."""
    name, _, camera = entry.partition(":")
    return name, camera or CAMERA


def frame_files(root: str | Path, entry: str, whole: bool = False) -> dict[int, Path]:
    """Image files of a sequence by frame number, in order; where there are none, an `InputError` names the cameras that are there.
    Those that are to be `whole`, to be scored, may have no gap."""
    name, camera = sequence_of(entry)
    folder = Path(root) / "sequences" / name / camera
    files = sorted(folder.iterdir() if folder.is_dir() else [], key=lambda file: (file.suffix.lower() == ".png", file))  # so PNG wins
    numbered = {int(file.stem): file for file in files if file.suffix in SUFFIXES and file.stem.isdecimal()}
    if not numbered:
        there = sorted(p.name for p in folder.parent.glob("image_*") if p.is_dir())
        hint = f"; there is {' and '.join(there)}, say `{name}:{there[0]}`" if there else "; download the sequence first"
        raise InputError(f"{folder}: no images{hint}")
    if whole and (gaps := set(range(min(numbered), max(numbered))) - set(numbered)):
        raise InputError(f"{folder}: frame {min(gaps)} is missing; a trajectory needs all frames")
    return dict(sorted(numbered.items()))


def true_trajectory(root: str | Path, entry: str) -> "Trajectory":
    """True poses of a scored sequence's frames; an `InputError` if the file is missing, bad, or shorter than the sequence."""
    path, numbers = poses_path(root, entry), list(frame_files(root, entry, whole=True))
    poses = read_trajectory(path).poses
    if numbers[-1] >= len(poses):
        raise InputError(f"{path}: has {len(poses)} poses, but the sequence has a frame {numbers[-1]}")
    return Trajectory(np.array(numbers), poses[numbers], False)


def sequence_intrinsics(root: str | Path, entry: str) -> np.ndarray:
    """Intrinsics (3, 3) of a sequence's camera, in pixels of its frames, from `calib.txt` (`P2: …`), or from `calib_p0_p1.txt`, two rows
    without names, where that is all there is. An `InputError` says that there is no calibration, or none of that camera."""
    name, camera = sequence_of(entry)
    path, bare = (Path(root) / "sequences" / name / file for file in ("calib.txt", "calib_p0_p1.txt"))
    path = bare if bare.is_file() and not path.is_file() else path
    return calibration_entry(read_calibration(path), f"P{camera.removeprefix('image_')}", 12, path).reshape(3, 4)[:, :3].copy()


def poses_path(root: str | Path, entry: str) -> Path:
    """File of a sequence's true poses: `poses/NN.txt`, or `poses.txt` beside its images."""
    name, _ = sequence_of(entry)
    common, own = Path(root) / "poses" / f"{name}.txt", Path(root) / "sequences" / name / "poses.txt"
    return own if own.is_file() and not common.is_file() else common


def drives_of(sequences: Iterable[str], *, world: bool) -> list[str]:
    """The drives that sequences show, for the guard against leaks: raw drives, or of the synthetic world streets of their own."""
    names = [sequence_of(entry)[0] for entry in sequences]
    return sorted({f"odometry/{name}" if world else RAW_DRIVES.get(name, f"odometry/{name}") for name in names})


def drives_to_guard(sequence: str) -> list[str]:
    """Drives that frames of a sequence are of, whether of KITTI or of the synthetic world: what a guard must look for. An
    `InputError` says that it is no sequence of KITTI's."""
    if sequence not in RAW_DRIVES:
        raise InputError(f"sequence {sequence!r}: give one of {', '.join(RAW_DRIVES)}")
    return [*drives_of([sequence], world=False), *drives_of([sequence], world=True)]


def odometry_triplets(root: str | Path, sequences: Sequence[str], broken: Collection[Path] = ()) -> list[Triplet]:
    """Triplets of some sequences; those of `broken` files are left out. An `InputError` names one that has no images, no calibration or
    not three consecutive frames."""
    found: list[Triplet] = []
    for entry in sequences:
        name, camera = sequence_of(entry)
        files, matrix = frame_files(root, entry), sequence_intrinsics(root, entry)
        whole = {number for number, file in files.items() if file not in broken}
        targets = [i for i in files if {i - 1, i, i + 1} <= whole]
        if not targets:
            raise InputError(f"{next(iter(files.values())).parent}: no three consecutive frames to train on")
        found += [Triplet(f"odometry/{name}/{camera}/{i:06d}", (files[i], files[i - 1], files[i + 1]), matrix, name) for i in targets]
    return found


FORMAT = "a KITTI pose file holds the 12 numbers of the 3x4 matrix [R|t] (or the 16 of 4x4) in a line, perhaps after the frame's number"
TOLERANCE = 3e-3  # How far R Rᵀ may be from the identity: three decimals and products of many float32 rotations pass.
LIMIT = 1e9  # Numbers from here on cannot be positions, whatever the unit, and would overflow later.


class Trajectory(NamedTuple):
    """Camera poses of a sequence."""

    frames: np.ndarray  # (N,) frame numbers, strictly increasing; those of a file without them are 0, 1, 2, …
    poses: np.ndarray  # (N, 4, 4) float64, camera to world, metres.
    indexed: bool  # Whether the file gave the frame numbers.


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a KITTI pose file: 12 numbers a line or the 16 of 4x4 matrices, and one more with a leading frame number. An `InputError` names
    the line: another number of numbers, text, NaN, no rotation matrix, or frame numbers that are not increasing integers."""
    with reading(path, FORMAT):
        text = Path(path).read_text(encoding="utf-8-sig", errors="replace")
    lines = [(number, line.split()) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    if not lines:
        raise InputError(f"{path}: empty; {FORMAT}")
    numbers = np.array([number for number, _ in lines])
    values = np.array([_row(words, len(lines[0][1]), f"{path}, line {number}") for number, words in lines])

    def refuse(bad: np.ndarray, what: str) -> None:
        if bad.any():
            raise InputError(f"{path}, line {numbers[bad.argmax()]}: {what}")

    refuse(~(np.abs(values) < LIMIT).all(1), f"NaN, infinite or beyond {LIMIT:g}; give finite numbers, positions in metres")
    indexed = values.shape[1] % 2 == 1
    if indexed:
        frames = values[:, 0]
        refuse((frames != np.round(frames)) | (frames < 0), "the frame number, the first of the line, is no integer from 0 up")
        refuse(np.diff(frames, prepend=-1) <= 0, "the frame number is not above the one before; sort the lines, one a frame")
    poses = np.tile(np.eye(4), (len(values), 1, 1))
    rows = values[:, int(indexed) :].reshape(len(values), -1, 4)
    refuse(np.abs(rows[:, 3:] - np.eye(4)[3]).max((1, 2), initial=0) > TOLERANCE, f"the last 4 of 16 numbers are not 0 0 0 1; {FORMAT}")
    poses[:, :3] = rows[:, :3]
    rotations = poses[:, :3, :3]
    orthonormal = np.abs(rotations @ rotations.mT - np.eye(3)).max((1, 2)) < TOLERANCE
    refuse(~orthonormal | (np.linalg.det(rotations) < 0), f"the left 3x4 columns are no rotation matrix; {FORMAT}")
    return Trajectory(values[:, 0].astype(np.int64) if indexed else np.arange(len(values)), poses, indexed)


def _row(words: list[str], width: int, where: str) -> list[float]:
    with reading(where, f"{FORMAT}, with spaces between"):
        values = [float(word) for word in words]
    if len(values) not in (12, 13, 16, 17) or len(values) != width:
        tum = ", which look like TUM's position and quaternion" * (len(values) in (7, 8))
        raise InputError(f"{where}: {len(values)} numbers{tum}, {width} in the first line; {FORMAT}, in all lines alike")
    return values


def write_trajectory(path: str | Path, poses: np.ndarray) -> None:
    """Write poses (N, 4, 4) or (N, 3, 4), camera to world, metres, as a KITTI pose file, atomically and without loss.
    An `InputError` says that it cannot be written."""
    rows = [" ".join(f"{value:.17g}" for value in np.asarray(pose, np.float64)[:3].ravel()) for pose in poses]
    try:
        write_text(path, "".join(f"{row}\n" for row in rows))
    except OSError as error:
        raise InputError(f"{path}: cannot write the poses ({error.strerror})") from None


def pair_frames(
    prediction: Trajectory, truth: Trajectory, names: tuple[str, str] = ("the prediction", "the ground truth")
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The frames (M,) that both trajectories have, predicted (M, 4, 4) and true poses (M, 4, 4); `names` are those of the two in messages.

    A prediction with frame numbers is matched by them; one without has a pose for each of the ground truth's, in order. The first pose
    of a ground truth without frame numbers is frame 0's. An `InputError` says that the lengths differ and the prediction has no frame
    numbers, or that no frame is in both.
    """
    ours, theirs = names
    if not prediction.indexed:
        if len(prediction.poses) != len(truth.poses):
            counts = f"{ours} has {len(prediction.poses)} poses but {theirs} has {len(truth.poses)}"
            raise InputError(f"{counts}; give one for each frame, or put the frame's number first in each line")
        return truth.frames, prediction.poses, truth.poses
    frames, at, true_at = np.intersect1d(prediction.frames, truth.frames, assume_unique=True, return_indices=True)
    if not len(frames):
        spans = [f"{t.frames[0]} to {t.frames[-1]}" for t in (prediction, truth)]
        raise InputError(f"{ours} has frames {spans[0]} and {theirs} {spans[1]}: none in common; are they of the same sequence?")
    return frames, prediction.poses[at], truth.poses[true_at]
