"""Trajectories of the odometry table: PoseNet's motions along the test sequences, chained, and the controls that they must beat."""

import numpy as np
import pandas as pd

from dualdepth.data import odometry
from dualdepth.data.odometry import Trajectory, drives_of, poses_path, read_trajectory, sequence_of, write_trajectory
from dualdepth.device import default_device
from dualdepth.evaluation.odometry import ALIGNMENTS, constant_velocity, inverted, mean_step, snippet_errors, snippets, trajectory_errors
from dualdepth.model import load_pose_net, predict_poses
from dualdepth.run import Run, Sources
from dualdepth.tables.scores import Trained

LENGTHS = (3, 5)  # Frames of a snippet: 3 as the paper, 5 as Zhou et al.
CONTROLS = {"constant": "Constant velocity", "straight": "Straight ahead", "inverted": "Ground truth, every pose inverted"}
"""What needs no learning, or is plainly wrong."""
NO_SEQUENCES = "no ODOMETRY_ROOT; get it with python data_scripts/download_kitti.py --root DIR --odometry"


def chain(motions: np.ndarray) -> np.ndarray:
    """Camera poses (N, 4, 4), camera → first camera, of a sequence from PoseNet's motions (N − 2, 2, 4, 4) of the frames 1 … N − 2.

    Motions are target → previous and target → next frame. The step from k to k + 1 is the one that the triplet around k gives; the first
    step, which has no such triplet, is from the triplet around 1.
    """
    poses = [np.eye(4), motions[0, 0]]
    for target_to_next in motions[:, 1]:
        poses.append(poses[-1] @ np.linalg.inv(target_to_next))
    return np.stack(poses)


def triplet_snippets(motions: np.ndarray) -> np.ndarray:
    """Snippets of three frames, each from one output of PoseNet as in SfMLearner: (N − 2, 3, 4, 4), camera → middle camera."""
    middle = np.broadcast_to(np.eye(4), (len(motions), 4, 4))
    return np.stack([np.linalg.inv(motions[:, 0]), middle, np.linalg.inv(motions[:, 1])], axis=1)


def true_trajectory(run: Run, entry: str) -> Trajectory:
    """`odometry.true_trajectory` of a run's test sequence."""
    return odometry.true_trajectory(Sources.load(run).odometry_root, entry)


def predicted_motions(training: Trained, entry: str, refine: bool = False) -> np.ndarray:
    """PoseNet's motions (N − 2, 2, 4, 4) along a test sequence, or refined ones (`refinement`); kept beside the weights and reused while
    they fit. An `InputError` says that the weights are missing, or were trained on the sequence."""
    training.check(drives_of([entry], world=training.run.profile.world is not None))
    files = list(odometry.frame_files(Sources.load(training.run).odometry_root, entry, whole=True).values())
    frames = [[str(f.resolve()), f.stat().st_size, f.stat().st_mtime_ns] for f in files]
    name = f"motions_{'_'.join(sequence_of(entry))}{'_refined' * refine}.npy"
    matrix = odometry.sequence_intrinsics(Sources.load(training.run).odometry_root, entry) if refine else None

    def make() -> np.ndarray:
        return predict_poses(*load_pose_net(training.weights, default_device()), files, training.model if refine else None, matrix)

    return training.kept(name, {"frames": frames, "intrinsics": matrix.tolist() if refine else None}, make)


def follow(training: Trained, entry: str, refine: bool = False) -> pd.DataFrame:
    """Score a training's PoseNet on a test sequence, and write its trajectory to `results/<profile>/trajectories`, in KITTI's format.

    Rows by (image, part): of parts such as "09, 3 frames" each snippet's `ate` and `rmse` in metres; of parts such as "09, 7dof", image 0,
    what `trajectory_errors` says of the whole trajectory.
    """
    motions, truth = predicted_motions(training, entry, refine), true_trajectory(training.run, entry)
    poses = chain(motions)
    file = f"{training.variant}_seed{training.seed}_{sequence_of(entry)[0]}{'_refined' * refine}.txt"
    write_trajectory(training.run.results / "trajectories" / file, poses)
    return _score(entry, truth, poses, {3: triplet_snippets(motions)})


def follow_control(run: Run, name: str, entry: str) -> pd.DataFrame:
    """Scores of one of `CONTROLS` on a test sequence, as of `follow`."""
    truth = true_trajectory(run, entry)
    # the field stores snippets, each in its first frame's axes: there the mistake is made
    cut = {length: inverted(snippets(truth.poses, length)) for length in LENGTHS} if name == "inverted" else {}
    return _score(entry, truth, control_poses(run, name, truth), cut)


def control_poses(run: Run, name: str, truth: Trajectory) -> np.ndarray:
    """Trajectory (N, 4, 4) of one of `CONTROLS` along a test sequence; the constant velocity is the mean of `known_sequences`."""
    if name == "straight":
        return constant_velocity(len(truth.frames), np.array([0.0, 0.0, 1.0]))
    if name == "inverted":
        return inverted(truth.poses)
    known = [read_trajectory(poses_path(Sources.load(run).odometry_root, entry)).poses for entry in known_sequences(run)]
    return constant_velocity(len(truth.frames), mean_step(known))


def known_sequences(run: Run) -> list[str]:
    """Training sequences whose true poses are there."""
    root, (train, _) = Sources.load(run).odometry_root, run.profile.odometry_sequences()
    return [sequence_of(entry)[0] for entry in train if poses_path(root, entry).is_file()]


def _score(entry: str, truth: Trajectory, poses: np.ndarray, given: dict[int, np.ndarray]) -> pd.DataFrame:
    """Scores of a trajectory along one sequence; `given` has snippets that are not cut from it."""
    cut = {length: snippets(poses, length) for length in LENGTHS} | given
    prediction, name = truth._replace(poses=poses), sequence_of(entry)[0]
    found = {f"{name}, {length} frames": snippet_errors(snippets(truth.poses, length), ours) for length, ours in cut.items()}
    found |= {f"{name}, {how}": pd.DataFrame([trajectory_errors(truth, prediction, how)]) for how in ALIGNMENTS}
    return pd.concat(found, names=["part", "image"]).swaplevel()
