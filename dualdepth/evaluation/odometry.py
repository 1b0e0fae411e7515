"""Scores of camera trajectories: errors of short snippets (Zhou et al. 2017) and of long segments (KITTI), and controls.

Poses are (N, 4, 4), camera to world, metres.
"""

from collections.abc import Iterable
from typing import Any

import numpy as np
import pandas as pd

from dualdepth.data.odometry import Trajectory, pair_frames
from dualdepth.errors import InputError

ALIGNMENTS = ("7dof", "none", "scale", "6dof", "scale_7dof")
"""How a prediction is laid on the ground truth; the first is for monocular methods, which know no scale."""
SEGMENTS = (100, 200, 300, 400, 500, 600, 700, 800)  # Metres of path that a segment must exceed.
STEP = 10  # Segments start at every tenth pose of the ground truth.


def relative(poses: np.ndarray) -> np.ndarray:
    """Poses (…, N, 4, 4) in the axes of the first, which becomes the identity."""
    moved = np.array(poses, np.float64)
    # positions first: where nothing moves they are exactly 0
    moved[..., :3, 3] -= poses[..., :1, :3, 3]
    return np.linalg.inv(moved[..., :1, :, :]) @ moved


def snippets(poses: np.ndarray, length: int, frames: np.ndarray | None = None) -> np.ndarray:
    """All overlapping windows of `length` poses (N, 4, 4): (S, L, 4, 4); none where there are fewer. Where increasing frame numbers (N,)
    are given, only windows of consecutive ones are cut."""
    starts = np.arange(max(len(poses) - length + 1, 0))
    if frames is not None:
        starts = starts[frames[starts + length - 1] - frames[starts] == length - 1]
    return poses[starts[:, None] + np.arange(length)]


def snippet_errors(truth: np.ndarray, prediction: np.ndarray) -> pd.DataFrame:
    """SfMLearner's absolute trajectory error of S snippets (S, L, 4, 4) of the same frames, in metres; rotations are not scored.

    Each is moved to its first frame and scaled by s = Σ⟨gt, pred⟩ / Σ⟨pred, pred⟩; one that does not move keeps scale 1. S rows: `ate` =
    √(Σ‖s·pred − gt‖²) / L, which is no RMSE but what the field prints as mean and population standard deviation; `rmse` = √(Σ‖s·pred − gt‖²
    / L).
    """
    gt, pred = relative(truth)[..., :3, 3], relative(prediction)[..., :3, 3]
    squares = (pred * pred).sum((1, 2))
    scale = np.divide((gt * pred).sum((1, 2)), squares, out=np.ones(len(gt)), where=squares > 0)
    total = ((scale[:, None, None] * pred - gt) ** 2).sum((1, 2))
    length = truth.shape[1]
    return pd.DataFrame({"ate": np.sqrt(total) / length, "rmse": np.sqrt(total / length)}).rename_axis("snippet")


def umeyama(source: np.ndarray, target: np.ndarray, *, with_scale: bool = True) -> tuple[np.ndarray, np.ndarray, float]:
    """Rotation R (3, 3), translation t (3,) and scale s that bring points (N, 3) nearest to others: Σ‖s R x + t − y‖² is least (Umeyama
    1991, equations 34-43). Points that are all one, and those `with_scale` off, have scale 1."""
    mean, target_mean = source.mean(0), target.mean(0)
    variance = ((source - mean) ** 2).sum() / len(source)
    u, d, vt = np.linalg.svd((target - target_mean).T @ (source - mean) / len(source))
    # where a mirror image would fit better than any rotation, the weakest axis is turned back
    signs = np.array([1.0, 1.0, -1.0 if np.linalg.det(u) * np.linalg.det(vt) < 0 else 1.0])
    rotation = (u * signs) @ vt
    scale = float(d @ signs / variance) if with_scale and variance > 0 else 1.0
    return rotation, target_mean - scale * rotation @ mean, scale


def aligned(prediction: np.ndarray, truth: np.ndarray, how: str = "7dof") -> np.ndarray:
    """The prediction laid on `relative(truth)`, after both are moved to their first frame, as Zhan's kitti-odom-eval does.

    All are (N, 4, 4), of the same frames. `how` is `none`; `scale`: the scale alone, by least squares; `6dof` and `7dof`: Umeyama's rigid
    and similarity transform of the positions, applied to the whole poses; `scale_7dof`: of the latter only the scale. The scale is 1
    where nothing moves. An unknown `how` is an `InputError`.
    """
    if how not in ALIGNMENTS:
        raise InputError(f"alignment {how!r} is unknown; choose one of {', '.join(ALIGNMENTS)}")
    moved, target = relative(prediction), relative(truth)[:, :3, 3]
    source, transform, scale = moved[:, :3, 3].copy(), np.eye(4), 1.0
    if how == "scale" and (squares := (source * source).sum()) > 0:
        scale = (source * target).sum() / squares
    elif how in ("6dof", "7dof", "scale_7dof"):
        rotation, shift, scale = umeyama(source, target, with_scale=how != "6dof")
        if how != "scale_7dof":
            transform[:3] = np.column_stack([rotation, shift])
    moved[:, :3, 3] *= scale
    return transform @ moved


def segment_errors(truth: Trajectory, prediction: Trajectory) -> pd.DataFrame:
    """KITTI's errors of segments of 100 to 800 m whose two ends are predicted, a row each: `first` and `last` (frame numbers), `length`
    (m), `t_err` (% of the length), `r_err` (degrees per 100 m).

    Segments start at every tenth pose of the whole ground truth and end at the first whose distance along the true path is more than the
    length. The prediction is aligned already, and its frames are numbered as the truth's.
    """
    steps = np.linalg.norm(np.diff(truth.poses[:, :3, 3], axis=0), axis=1)
    distance = np.concatenate([[0.0], np.cumsum(steps)])
    starts, lengths = (a.ravel() for a in np.meshgrid(np.arange(0, len(distance), STEP), SEGMENTS, indexing="ij"))
    ends = np.searchsorted(distance, distance[starts] + lengths, side="right")
    at = pd.Index(prediction.frames).get_indexer([*truth.frames, -1])  # −1 where the prediction has no such frame, as behind the path's end
    starts, lengths, ends = (a[(at[starts] >= 0) & (at[ends] >= 0)] for a in (starts, lengths, ends))
    error = _between(_between(prediction.poses[at[starts]], prediction.poses[at[ends]]), _between(truth.poses[starts], truth.poses[ends]))
    columns = {"first": truth.frames[starts], "last": truth.frames[ends], "length": lengths}
    shift = np.linalg.norm(error[:, :3, 3], axis=1)
    return pd.DataFrame(columns | {"t_err": 100 * shift / lengths, "r_err": 100 * _angle(error) / lengths})


def trajectory_errors(truth: Trajectory, prediction: Trajectory, align: str = "7dof") -> dict[str, Any]:
    """Errors of a whole trajectory after `aligned`, in the frames that both have (`pair_frames`), with the `InputError` of either.

    `t_err` (%) and `r_err` (degrees per 100 m) are means over all segments of `segment_errors`, `segments` their number; `ate` (m) is the
    true RMSE of the positions; `rpe_t` (m) and `rpe_r` (degrees) are means over frames with consecutive numbers. NaN where there is no
    segment or no such pair.
    """
    frames, poses, true_poses = pair_frames(prediction, truth)
    poses, true_poses = aligned(poses, true_poses, align), relative(true_poses)
    segments = segment_errors(truth, Trajectory(frames, poses, True))
    neighbours = np.flatnonzero(np.diff(frames) == 1)
    step, true_step = (_between(p[neighbours], p[neighbours + 1]) for p in (poses, true_poses))
    error = _between(true_step, step)
    return {
        "t_err": float(segments["t_err"].mean()),
        "r_err": float(segments["r_err"].mean()),
        "ate": float(np.sqrt(((poses - true_poses)[:, :3, 3] ** 2).sum(1).mean())),
        "rpe_t": float(np.linalg.norm(error[:, :3, 3], axis=1).mean()) if len(error) else float("nan"),
        "rpe_r": float(_angle(error).mean()) if len(error) else float("nan"),
        "segments": len(segments),
    }


def yaw_and_step(poses: np.ndarray) -> np.ndarray:
    """How far each pose turns to the right, in degrees, and goes forward, in metres, from the one before: (N − 1, 2) of poses (N, 4, 4)."""
    moved = _between(poses[:-1], poses[1:])
    return np.stack([np.degrees(np.arctan2(moved[:, 0, 2], moved[:, 2, 2])), moved[:, 2, 3]], axis=1)


def _between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.linalg.inv(first) @ second


def _angle(error: np.ndarray) -> np.ndarray:
    """Degrees, from the trace, as the field does: below some 1e-6 degrees it is rounding."""
    return np.degrees(np.arccos(np.clip((np.trace(error[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1)))


def mean_step(sequences: Iterable[np.ndarray]) -> np.ndarray:
    """(3,) mean translation from a frame to the next in the former's axes, over all steps of all sequences (N, 4, 4)."""
    return np.concatenate([_between(poses[:-1], poses[1:])[:, :3, 3] for poses in sequences]).mean(0)


def constant_velocity(frames: int, step: np.ndarray) -> np.ndarray:
    """Control: poses (N, 4, 4) of N frames that never turn and make the same `step` (3,), in metres, such as `mean_step`, each frame."""
    poses = np.tile(np.eye(4), (frames, 1, 1))
    poses[:, :3, 3] = np.arange(frames)[:, None] * step
    return poses


def inverted(truth: np.ndarray) -> np.ndarray:
    """Control: the true poses (…, N, 4, 4) in the axes of the first, each inverted. Of `snippets`, it is the mistake that their errors
    hardly see; of a whole trajectory, one that `trajectory_errors` sees."""
    return np.linalg.inv(relative(truth))
