"""Trajectory errors against closed forms and slow references."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from dualdepth.data.odometry import Trajectory
from dualdepth.errors import InputError
from dualdepth.evaluation import odometry
from dualdepth.evaluation.odometry import aligned, segment_errors, snippet_errors, snippets, trajectory_errors, umeyama


def pose(rotation=None, position=(0, 0, 0)):
    matrix = np.eye(4)
    matrix[:3, :3] = np.eye(3) if rotation is None else rotation
    matrix[:3, 3] = position
    return matrix


def yaw(angle):
    return Rotation.from_euler("y", angle).as_matrix()


def straight(count, step=1.0):
    return np.stack([pose(position=(0, 0, step * k)) for k in range(count)])


def circle(count, radius, start=(0, 0, 0)):
    """A whole round of `count` poses that look along the tangent."""
    angles = 2 * np.pi * np.arange(count) / count
    return np.stack([pose(yaw(a), np.add(start, [radius * (1 - np.cos(a)), 0, radius * np.sin(a)])) for a in angles])


def wander(count, seed, step=1.5):
    """A drive that turns at random."""
    rng = np.random.default_rng(seed)
    poses = [pose(Rotation.random(rng=rng).as_matrix(), rng.normal(0, 9, 3))]
    for _ in range(count - 1):
        turn = Rotation.from_rotvec(rng.normal(0, 0.03, 3)).as_matrix()
        poses.append(poses[-1] @ pose(turn, (0.05 * rng.normal(), 0.05 * rng.normal(), step * rng.uniform(0.2, 1.8))))
    return np.stack(poses)


def scaled(poses, scale):
    out = poses.copy()
    out[:, :3, 3] *= scale
    return out


def drive(poses, frames=None):
    return Trajectory(np.arange(len(poses)) if frames is None else np.array(frames), poses, frames is not None)


def slow_snippets(truth, prediction, length):
    """√sum/N and RMSE of every snippet, one coordinate at a time."""
    rows = []
    for start in range(len(truth) - length + 1):
        points = []
        for poses in (truth, prediction):
            origin, turn = poses[start][:3, 3], poses[start][:3, :3]
            points.append([turn.T @ (poses[start + k][:3, 3] - origin) for k in range(length)])
        pairs = [(g, p) for gt, pred in zip(*points) for g, p in zip(gt, pred)]
        scale = sum(g * p for g, p in pairs) / sum(p * p for _, p in pairs)
        total = sum((scale * p - g) ** 2 for g, p in pairs)
        rows.append((math.sqrt(total) / length, math.sqrt(total / length)))
    return rows


def slow_segments(truth, prediction):
    """KITTI's segments by plain loops over dicts of poses; (first, length) → (last, %, degrees per 100 m)."""
    distance = {0: 0.0}
    for k in range(1, len(truth)):
        distance[k] = distance[k - 1] + math.dist(truth[k][:3, 3], truth[k - 1][:3, 3])
    found = {}
    for first in range(0, len(truth), 10):
        for length in range(100, 900, 100):
            last = next((k for k in range(first, len(truth)) if distance[k] > distance[first] + length), None)
            if last is None or first not in prediction or last not in prediction:
                continue
            true_move = np.linalg.solve(truth[first], truth[last])
            move = np.linalg.solve(prediction[first], prediction[last])
            error = np.linalg.solve(move, true_move)
            angle = Rotation.from_matrix(error[:3, :3]).magnitude()
            found[first, length] = (last, 100 * math.hypot(*error[:3, 3]) / length, 100 * math.degrees(angle) / length)
    return found


def slow_alignment(source, target, with_scale):
    """Rotation by SciPy, the scale and the shift that are best for it."""
    x, y = source - source.mean(0), target - target.mean(0)
    rotation = Rotation.align_vectors(y, x)[0].as_matrix()
    scale = np.sum(y * (x @ rotation.T)) / np.sum(x * x) if with_scale else 1.0
    return rotation, target.mean(0) - scale * rotation @ source.mean(0), scale


@pytest.mark.parametrize("length", [3, 5])
def test_snippet_errors_equal_the_slow_reference(length):
    truth, prediction = wander(30, 0), wander(30, 1, step=0.02)
    errors = snippet_errors(snippets(truth, length), snippets(prediction, length))
    np.testing.assert_allclose(errors[["ate", "rmse"]], slow_snippets(truth, prediction, length), rtol=1e-9)
    assert len(errors) == 30 - length + 1


def test_a_prediction_that_does_not_move_keeps_scale_1():
    still = np.tile(wander(9, 0)[-1], (3, 1, 1))[None]  # anywhere: rounding must not count as movement
    errors = snippet_errors(straight(3)[None], still)
    assert errors["ate"].tolist() == pytest.approx([math.sqrt(1 + 4) / 3])
    assert errors["rmse"].tolist() == pytest.approx([math.sqrt(5 / 3)])


def test_snippets_overlap_and_cross_no_gap():
    poses = straight(7)
    assert snippets(poses, 3)[:, :, 2, 3].tolist() == [[k, k + 1, k + 2] for k in range(5)]
    kept = snippets(poses, 3, np.array([0, 1, 2, 4, 5, 6, 7]))
    assert kept[:, :, 2, 3].tolist() == [[0, 1, 2], [3, 4, 5], [4, 5, 6]]
    assert snippets(poses[:2], 3).shape == (0, 3, 4, 4) == snippets(poses[:2], 3, np.arange(2)).shape
    assert len(snippet_errors(snippets(poses[:2], 3), snippets(poses[:2], 3))) == 0


@pytest.mark.parametrize("with_scale", [True, False])
@pytest.mark.parametrize("mirrored", [False, True])
def test_umeyama_equals_scipy_also_where_a_mirror_image_would_fit(with_scale, mirrored):
    rng = np.random.default_rng(0)
    source = rng.normal(0, (5, 3, 1), (50, 3))
    target = 2.5 * source @ Rotation.random(rng=rng).as_matrix().T * ([-1, 1, 1] if mirrored else 1) + [4, 5, 6]
    target += rng.normal(0, 0.1, target.shape)
    found, expected = umeyama(source, target, with_scale=with_scale), slow_alignment(source, target, with_scale)
    for ours, theirs in zip(found, expected):
        np.testing.assert_allclose(ours, theirs, rtol=1e-6, atol=1e-6)
    assert np.linalg.det(found[0]) == pytest.approx(1)


@pytest.mark.parametrize("how", odometry.ALIGNMENTS)
def test_alignments_equal_the_slow_reference(how):
    truth, prediction = wander(80, 4), scaled(wander(80, 5), 0.1)
    moved = np.linalg.inv(prediction[0]) @ prediction
    target = (np.linalg.inv(truth[0]) @ truth)[:, :3, 3]
    own = moved[:, :3, 3]
    rotation, shift, scale = np.eye(3), np.zeros(3), 1.0
    if how == "scale":
        scale = np.vdot(own, target) / np.vdot(own, own)
    elif how != "none":
        rotation, shift, scale = slow_alignment(own, target, how != "6dof")
        if how == "scale_7dof":
            rotation, shift = np.eye(3), np.zeros(3)
    expected = [pose(rotation @ m[:3, :3], scale * rotation @ m[:3, 3] + shift) for m in moved]
    np.testing.assert_allclose(aligned(prediction, truth, how), expected, atol=1e-8)


@pytest.mark.parametrize("how", odometry.ALIGNMENTS)
def test_a_prediction_that_does_not_move_is_aligned_to_finite_poses(how):
    still = np.tile(np.eye(4), (20, 1, 1))
    assert np.isfinite(aligned(still, circle(20, 3.0), how)).all()


def test_an_unknown_alignment_is_named():
    with pytest.raises(InputError, match="'sim3' is unknown; choose one of 7dof, none"):
        aligned(straight(3), straight(3), "sim3")


@pytest.mark.parametrize("share", [1, 0.7])
def test_segments_equal_the_slow_reference_and_need_both_ends(share):
    truth, prediction = wander(700, 6), wander(700, 7)
    frames = np.flatnonzero(np.random.default_rng(0).random(700) < share)
    errors = segment_errors(drive(truth), drive(prediction[frames], frames)).set_index(["first", "length"])
    expected = slow_segments(truth, {k: prediction[k] for k in frames.tolist()})
    assert list(errors.index) == list(expected) and {length for _, length in expected} == set(odometry.SEGMENTS)
    assert errors["last"].tolist() == [last for last, _, _ in expected.values()]
    np.testing.assert_allclose(errors[["t_err", "r_err"]], [row[1:] for row in expected.values()], rtol=1e-6)


def test_yaw_drift_in_closed_form():
    truth = straight(300)
    prediction = truth.copy()
    prediction[:, :3, :3] = [yaw(np.radians(0.02 * k)) for k in range(300)]
    result = trajectory_errors(drive(truth), drive(prediction), "none")
    lengths = segment_errors(drive(truth), drive(prediction))["length"]
    assert result["r_err"] == pytest.approx(np.mean([0.02 * (n + 1) / n * 100 for n in lengths]), rel=1e-6)
    assert result["rpe_r"] == pytest.approx(0.02, rel=1e-4)
    assert result["ate"] == 0 and result["segments"] == len(lengths)


def test_a_wrong_scale_in_closed_form():
    truth, prediction = straight(401, 2.0), straight(401, 1.5)
    result = trajectory_errors(drive(truth), drive(prediction), "none")
    lengths = segment_errors(drive(truth), drive(prediction))["length"]
    assert result["t_err"] == pytest.approx(np.mean([100 * 0.25 * (n + 2) / n for n in lengths]))
    assert result["ate"] == pytest.approx(0.5 * math.sqrt(sum(k * k for k in range(401)) / 401))
    assert result["rpe_t"] == pytest.approx(0.5) and result["rpe_r"] == 0 == result["r_err"]
    for how in ("7dof", "scale", "scale_7dof"):
        mended = trajectory_errors(drive(truth), drive(prediction), how)
        assert [mended[name] for name in ("t_err", "ate", "rpe_t")] == pytest.approx([0, 0, 0], abs=1e-9)


def test_neighbours_have_consecutive_numbers():
    truth = straight(30)
    frames = [0, 1, 2, 10, 11, 20]
    prediction = drive(scaled(truth[frames], 0.5), frames)
    result = trajectory_errors(drive(truth), prediction, "none")
    assert result["rpe_t"] == pytest.approx(0.5)
    lonely = trajectory_errors(drive(truth), drive(truth[[0, 10, 20]], [0, 10, 20]), "none")
    assert math.isnan(lonely["rpe_t"]) and math.isnan(lonely["rpe_r"]) and lonely["ate"] == 0


def test_the_mean_step_counts_every_step_once():
    turned = pose(yaw(1.2), (5, 5, 5)) @ straight(2, 4.0)
    np.testing.assert_allclose(odometry.mean_step([straight(4), turned]), [0, 0, (3 * 1 + 4) / 4], atol=1e-12)
