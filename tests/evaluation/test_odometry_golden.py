"""Trajectory errors of real trajectories: golden numbers, and the truth against itself."""

import numpy as np
import pytest

from dualdepth.data.odometry import read_trajectory
from dualdepth.evaluation import odometry
from dualdepth.evaluation.odometry import snippet_errors, snippets, trajectory_errors

AHEAD = np.array([0, 0, 1.0])


@pytest.fixture(scope="module")
def truths(real):
    return {f"{n:02d}": read_trajectory(real(f"kitti_odometry/poses/{n:02d}.txt")) for n in range(11)}


SNIPPET_GOLDEN = {
    ("constant", 3): {"09": "0.0163 0.0130", "10": "0.0131 0.0127"},
    ("constant", 5): {"09": "0.0323 0.0260", "10": "0.0237 0.0234"},
    ("straight", 3): {"09": "0.0237 0.0109", "10": "0.0181 0.0122"},
    ("straight", 5): {"09": "0.0419 0.0223", "10": "0.0304 0.0222"},
    ("inverted", 3): {"09": "0.0150 0.0128", "10": "0.0088 0.0102"},
    ("inverted", 5): {"09": "0.0403 0.0352", "10": "0.0232 0.0278"},
}


@pytest.mark.parametrize("sequence", ["09", "10"])
@pytest.mark.parametrize("control, length", list(SNIPPET_GOLDEN))
def test_golden_snippets(truths, control, sequence, length):
    poses = truths[sequence].poses
    truth = snippets(poses, length)
    if control == "inverted":
        prediction = odometry.inverted(truth)
    elif control == "straight":
        prediction = snippets(odometry.constant_velocity(len(poses), AHEAD), length)
    else:
        step = odometry.mean_step(truths[f"{n:02d}"].poses for n in range(9))
        prediction = snippets(odometry.constant_velocity(len(poses), step), length)
    ate = snippet_errors(truth, prediction)["ate"]
    assert f"{ate.mean():.4f} {ate.std(ddof=0):.4f}" == SNIPPET_GOLDEN[control, length][sequence]
    assert len(ate) == {"09": 1591, "10": 1201}[sequence] - length + 1


TRAJECTORY_GOLDEN = {
    ("example_1", "none"): ("2.61 0.29 17.92", "2.29 0.37 9.04"),
    ("example_1", "scale"): ("2.67 0.29 17.88", "2.28 0.37 9.03"),
    ("example_1", "scale_7dof"): ("2.53 0.29 18.35", "2.22 0.37 9.56"),
    ("example_1", "6dof"): ("2.61 0.29 10.88", "2.29 0.37 3.72"),
    ("example_1", "7dof"): ("2.53 0.29 10.73", "2.22 0.37 3.36"),
    ("example_0", "none"): ("72.11 0.25 349.64", "82.07 0.30 425.38"),
    ("example_0", "scale"): ("2.87 0.25 10.64", "3.90 0.30 12.93"),
    ("example_0", "7dof"): ("2.88 0.25 8.39", "3.30 0.30 6.63"),
}


@pytest.mark.parametrize("example, align", list(TRAJECTORY_GOLDEN))
def test_golden_trajectories(truths, real, example, align):
    for sequence, golden in zip(("09", "10"), TRAJECTORY_GOLDEN[example, align]):
        prediction = read_trajectory(real(f"kitti_odometry/predictions/{example}/{sequence}.txt"))
        result = trajectory_errors(truths[sequence], prediction, align)
        assert " ".join(f"{result[name]:.2f}" for name in ("t_err", "r_err", "ate")) == golden
        if (example, align) == ("example_1", "none"):
            steps = f"{result['rpe_t']:.3f} {result['rpe_r']:.3f}"
            assert steps == {"09": "0.056 0.037", "10": "0.047 0.043"}[sequence]
