"""From PoseNet's motions to trajectories and their scores, on sequences that are made here."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest
import torch
from scipy.spatial.transform import Rotation
from small_kitti import write_calibration, write_sequence
from torch import nn

from dualdepth.data.frames import resample
from dualdepth.data.kitti import read_image
from dualdepth.data.odometry import read_trajectory, sequence_intrinsics, write_trajectory
from dualdepth.errors import InputError
from dualdepth.evaluation.odometry import relative, snippet_errors, snippets, yaw_and_step
from dualdepth.geometry import low_resolution, pose_matrix, resize_intrinsics, to_unit
from dualdepth.model import predict_poses, tensor_of
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.pose_net import PoseNet
from dualdepth.refinement import refined
from dualdepth.run import Run, Sources
from dualdepth.tables import odometry as table_module
from dualdepth.tables.odometry import odometry_claims, odometry_scores, odometry_table, trajectory_table
from dualdepth.tables.scores import Scores, Trained
from dualdepth.tables.trajectories import chain, control_poses, follow, follow_control, predicted_motions, triplet_snippets, true_trajectory
from dualdepth.training.weights import save_weights
from tests.small_checkout import write_profile

SIZE = (192, 192)


def driven(turns, moves):
    """Poses (N, 4, 4), camera to world, of a camera that turns and then moves, step by step."""
    poses = [np.eye(4)]
    for turn, move in zip(turns.as_matrix(), moves, strict=True):
        step = np.eye(4)
        step[:3, :3], step[:3, 3] = turn, move
        poses.append(poses[-1] @ step)
    return np.stack(poses)


def winding(count):
    """Poses that turn and climb."""
    rng = np.random.default_rng(0)
    return driven(Rotation.from_rotvec(rng.normal(0, 0.1, (count - 1, 3))), rng.normal([0, 0, 1], 0.1, (count - 1, 3)))


def of_a_car(yaws, steps):
    """Poses of a car that turns by `yaws` degrees to the right and then goes `steps` metres forward."""
    return driven(Rotation.from_euler("y", np.reshape(yaws, (-1, 1)), degrees=True), np.outer(steps, [0, 0, 1]))


def motions_of(poses):
    """What a perfect PoseNet says: target → previous and target → next."""
    inverse = np.linalg.inv(poses)
    return np.stack([np.stack([inverse[k - 1] @ poses[k], inverse[k + 1] @ poses[k]]) for k in range(1, len(poses) - 1)])


def test_perfect_motions_give_the_true_trajectory_and_snippets_and_inverted_ones_do_not():
    poses = winding(12)
    motions = motions_of(poses)
    np.testing.assert_allclose(chain(motions), poses, atol=1e-12)
    errors = snippet_errors(snippets(poses, 3), triplet_snippets(motions))
    assert len(errors) == 10 and errors.to_numpy().max() < 1e-12
    assert np.abs(chain(np.linalg.inv(motions)) - poses).max() > 0.5


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    net = PoseNet()
    with torch.no_grad():
        nn.init.xavier_uniform_(net.layers[-1].weight)
        net.layers[-1].bias.normal_(0, 0.3)  # motions that can be told from none
    return net.eval()


@pytest.mark.parametrize("batch_size", [1, 3, 16])
def test_each_triplet_is_seen_once_target_first(net, tmp_path, batch_size):
    write_sequence(tmp_path, "09", range(7))
    files = sorted((tmp_path / "sequences/09/image_2").iterdir())
    motions = predict_poses(net, SIZE, files, batch_size=batch_size)
    assert motions.shape == (5, 2, 4, 4) and motions.dtype == np.float64
    images = [torch.from_numpy(resample(read_image(f), SIZE)).permute(2, 0, 1).float() / 255 for f in files]
    small = [torch.nn.functional.avg_pool2d(i[None], 3)[0] for i in images]
    for k in range(1, 6):
        with torch.inference_mode():
            expected = pose_matrix(net(torch.stack([small[k], small[k - 1], small[k + 1]])[None]).double())[0]
        np.testing.assert_allclose(motions[k - 1], expected, atol=1e-6)
    with pytest.raises(InputError, match="2 frames"):
        predict_poses(net, SIZE, files[:2])


@pytest.mark.parametrize(("size", "expected"), [(SIZE, 3), ((384, 576), 6)])
def test_large_images_are_refined_in_more_steps(net, tmp_path, monkeypatch, size, expected):
    write_sequence(tmp_path, "09", range(3))
    files, asked = sorted((tmp_path / "sequences/09/image_2").iterdir()), []
    monkeypatch.setattr("dualdepth.model.refined", lambda *given: asked.append(given[-1]) or given[2].clone())
    depth = SimpleNamespace(disparities=lambda images: np.ones((len(images), 8, 8), np.float32), card={})
    predict_poses(net, size, files, depth, sequence_intrinsics(tmp_path, "09"))
    assert asked == [expected]


@pytest.fixture
def run(tmp_path, net):
    """A run with weights of an odometry training, and sequences 00 and 09."""
    root = tmp_path / "data"
    write_sequence(root, "00", range(4))
    write_sequence(root, "09", range(8))
    write_calibration(tmp_path / "raw")
    data = {"source": "kitti", "train_drives": ["d"], "odometry_train": ["00"], "odometry_test": ["09"], "hr_size": SIZE}
    trained = {"lr": None, "odometry_lr": None}
    run = Run(write_profile(tmp_path / "own.yaml", "resnet18", {}, data=data, train=trained), tmp_path)
    Sources(tmp_path / "raw", tmp_path / "list.txt", odometry_root=root).save(run)
    save(run, net, ["2011_10_03/2011_10_03_drive_0027_sync"])
    return run


def save(run, net, drives, variant="odometry_lr"):
    card = {"hr_size": list(SIZE), "drives": drives, "pretrained": False, "steps": 2, "starts_from": None}
    architecture = Architecture(network="lr", encoder="resnet18")
    path = run.weights(variant, 0)
    path.parent.mkdir(parents=True, exist_ok=True)
    both = torch.nn.ModuleDict({"pose_net": net, "depth_net": architecture.build(False)})
    save_weights(path, both, card | architecture.model_dump() | {"seed": 0})


def training(run):
    """The odometry training, as another notebook sees it."""
    return Trained(run, "odometry_lr", 0)


def part(frame, name):
    return frame.xs(name, level="part")


def test_a_sequence_is_scored_and_its_trajectory_written(run):
    found = follow(training(run), "09")
    whole = {f"09, {how}": 1 for how in ("7dof", "none", "scale", "6dof", "scale_7dof")}
    assert found["ate"].groupby(level="part").size().to_dict() == whole | {"09, 3 frames": 6, "09, 5 frames": 4}
    written = read_trajectory(run.results / "trajectories" / "odometry_lr_seed0_09.txt")
    np.testing.assert_allclose(written.poses, chain(predicted_motions(training(run), "09")), atol=1e-5)


def test_motions_are_kept_as_long_as_weights_and_frames_are_the_same(run, net, tmp_path, monkeypatch):
    made = []
    monkeypatch.setattr("dualdepth.tables.trajectories.predict_poses", lambda *given: made.append(given) or predict_poses(*given))

    def times():
        predicted_motions(training(run), "09")
        return len(made)

    assert (times(), times()) == (1, 1)
    first, second, *_ = sorted((tmp_path / "data/sequences/09/image_2").iterdir())
    first.write_bytes(second.read_bytes())
    assert (times(), times()) == (2, 2)
    save(run, PoseNet(), [])
    assert (times(), times()) == (3, 3)


def test_motions_are_also_refined_with_the_depth_that_learned_beside_posenet(run, net, tmp_path):
    files = sorted((tmp_path / "data/sequences/09/image_2").iterdir())
    images = [read_image(file) for file in files]
    small = torch.stack([low_resolution(to_unit(tensor_of(image, SIZE))[None])[0] for image in images])
    views = torch.stack([small[1:-1], small[:-2], small[2:]], 1)
    near = torch.from_numpy(training(run).model.disparities(images[1:-1]))[:, None]
    raw = torch.tensor(sequence_intrinsics(tmp_path / "data", "09"), dtype=torch.float32)
    matrix = resize_intrinsics(raw, 64 / images[0].shape[1], 64 / images[0].shape[0]).expand(6, 3, 3)
    with torch.inference_mode():
        expected = pose_matrix(refined(views, near, net(views), matrix).double())
        expected[..., :3, 3] /= near.mean(dim=(1, 2, 3))[:, None, None]  # in the unit of the disparities as they are
    found, alone = (predicted_motions(training(run), "09", refine) for refine in (True, False))
    np.testing.assert_allclose(found, expected, atol=1e-4)
    np.testing.assert_allclose(alone, predict_poses(net, SIZE, files))
    assert np.abs(found - alone).max() > 1e-3
    table = odometry_table(run, odometry_scores(run, [0])).query("source == 'measured'").set_index(["method", "frames"])
    rows = [table.loc[(f"Ours (LR-Net){end}", 3)] for end in ("", ", poses refined")]
    assert rows[0]["snippet_ate_mean_09"] != rows[1]["snippet_ate_mean_09"] and "direct image alignment" in rows[1]["note"]
    assert {f"odometry_lr_seed0_09{end}.txt" for end in ("", "_refined")} == {f.name for f in (run.results / "trajectories").iterdir()}


def test_weights_that_saw_the_sequences_raw_drive_are_refused_or_named_in_the_table(run, net):
    drive = "2011_09_30/2011_09_30_drive_0033_sync"
    save(run, net, [drive])
    with pytest.raises(InputError, match=rf"model\.safetensors: was trained on {drive}"):
        follow(training(run), "09")
    Sources.load(run)._replace(allow_leak=True).save(run)
    table = odometry_table(run, odometry_scores(run, [0])).query("variant.str.startswith('odometry_lr', na=False)", engine="python")
    assert table["leak"].eq(f"LEAK: trained on {drive}").all() and len(table) == 4


def test_controls_know_nothing_of_the_images(run):
    truth = true_trajectory(run, "09")
    assert control_poses(run, "straight", truth)[3, :3, 3].tolist() == [0, 0, 3]
    # the training sequence goes a metre a frame sideways, as the test sequence does
    np.testing.assert_allclose(control_poses(run, "constant", truth), relative(truth.poses), atol=1e-12)
    assert part(follow_control(run, "constant", "09"), "09, 3 frames")["ate"].max() < 1e-12
    np.testing.assert_allclose(control_poses(run, "inverted", truth) @ truth.poses, np.broadcast_to(np.eye(4), (8, 4, 4)), atol=1e-12)


def test_inverting_a_snippets_poses_hardly_shows_in_its_score(run):
    path = Sources.load(run).odometry_root / "poses/09.txt"
    poses = winding(8)
    write_trajectory(path, poses)
    found = follow_control(run, "inverted", "09")
    cut = snippets(poses, 3)
    expected = snippet_errors(cut, np.linalg.inv(relative(cut)))["ate"]
    np.testing.assert_allclose(part(found, "09, 3 frames")["ate"], expected, atol=1e-9)
    assert expected.mean() < 0.2 < part(found, "09, 7dof")["rpe_t"].item()


def test_a_gap_between_frames_and_fewer_poses_than_frames_are_named(run):
    root = Sources.load(run).odometry_root
    poses = root / "poses/09.txt"
    poses.write_text("".join(poses.read_text().splitlines(keepends=True)[:5]))
    with pytest.raises(InputError, match=r"09\.txt: has 5 poses, but the sequence has a frame 7"):
        follow_control(run, "straight", "09")
    (root / "sequences/09/image_2/000004.png").unlink()
    with pytest.raises(InputError, match="image_2: frame 4 is missing"):
        true_trajectory(run, "09")


def test_the_table_has_the_papers_rows_ours_and_the_controls_at_both_lengths(run):
    table = odometry_table(run, odometry_scores(run, [0]))
    made = table[table["source"] != "paper"]
    assert len(table) - len(made) == 8
    assert made["frames"].tolist() == [3] * 6 + [5] * 6
    ours = made[made["variant"] == "odometry_lr"]
    expected = [part(follow(training(run), "09"), f"09, {n} frames")["ate"] for n in (3, 5)]
    assert ours["snippet_ate_mean_09"].tolist() == pytest.approx([errors.mean() for errors in expected])
    assert ours["snippet_ate_std_09"].tolist() == pytest.approx([errors.std(ddof=0) for errors in expected])
    assert ours["n"].tolist() == [6, 4]
    missing = made[made["method"] == "Ours (LR-Net+HR-Net)"]
    assert missing["reason"].eq("profile own does not train odometry_dual").all() and missing["snippet_ate_mean_09"].isna().all()


def test_without_the_folder_every_row_says_how_to_get_it(run):
    Sources.load(run)._replace(odometry_root=None).save(run)
    scores = odometry_scores(run, [0])
    for table in (odometry_table(run, scores), trajectory_table(run, scores)):
        ours = table[table["source"] == "not run"]
        assert ours["reason"].eq(table_module.trajectories.NO_SEQUENCES).all() and len(ours)
    assert odometry_claims(run, scores).empty


def test_without_true_poses_of_training_sequences_the_constant_velocity_says_so_and_all_else_is_scored(run, monkeypatch):
    monkeypatch.setattr(table_module.trajectories, "known_sequences", lambda run: [])
    table = odometry_table(run, odometry_scores(run, [0])).query("frames == 3").set_index("method")
    assert table.loc["Constant velocity", "reason"] == "there are no true poses of training sequences, whose mean step this would be"
    assert table.loc["Straight ahead", "source"] == "measured"


def test_claims_say_which_control_is_beaten(run):
    methods = {("odometry_lr", 0): (10.0, 0.02), ("odometry_lr", 1): (11.0, 0.02), ("constant", 0): (10.5, 0.01)}
    methods |= {("straight", 0): (50.0, 0.01), ("inverted", 0): (50.0, 0.01)}
    rows = {}
    for (name, seed), (t_err, ate) in methods.items():
        rows |= {(name, seed, k, "09, 3 frames"): {"ate": ate + 1e-3 * k} for k in range(99 if name == "inverted" else 100)}
        rows[name, seed, 0, "09, 7dof"] = {"t_err": t_err, "segments": 5}
    frame = pd.DataFrame.from_dict(rows, orient="index").rename_axis(["variant", "seed", "image", "part"])
    table = odometry_claims(run, Scores(frame, {"odometry_lr": []}, {})).set_index(["b", "metric"])
    assert table.loc[("straight", "t_err"), "in_words"] == "better by 39.5 points of t_err; better with 2 of 2 seeds"
    assert table.loc[("constant", "t_err"), "in_words"] == "the same" and table.loc[("inverted", "snippet_ate_3"), "n"] == 99
    assert list(table.loc[:, "in_words"].xs("snippet_ate_3", level="metric").str[:13]) == ["worse by 0.01"] * 2 + [""]


def test_a_path_too_short_for_a_segment_says_so(run):
    scores = odometry_scores(run, [0])
    table = trajectory_table(run, scores)
    assert table["note"].eq("no segment of 100 m: the path is too short")[table["segments"].eq(0)].all()
    assert odometry_claims(run, scores).query("metric == 't_err'")["reason"].eq("the path is too short for a segment").all()


def test_yaw_is_positive_to_the_right_and_steps_go_forward():
    np.testing.assert_allclose(yaw_and_step(of_a_car([2, 2, -1], [1.5, 1, 0.5])), [[2, 1.5], [2, 1], [-1, 0.5]], atol=1e-12)


def test_a_pose_net_that_turns_half_as_far_and_always_to_the_left(run, monkeypatch):
    yaws, steps = np.random.default_rng(0).normal(0, 3, 7), np.random.default_rng(1).uniform(1, 2, 7)
    truth = table_module.trajectories.true_trajectory(run, "09")._replace(poses=of_a_car(yaws, steps))
    monkeypatch.setattr(table_module.trajectories, "true_trajectory", lambda run, entry: truth)
    monkeypatch.setattr(table_module.trajectories, "predicted_motions", lambda *_: motions_of(of_a_car(yaws / 2 - 1, 0.1 * steps)))
    of_seeds = [Trained(run, "odometry_lr", seed) for seed in (0, 1)]
    row = table_module.motion_table(run, Scores(None, {"odometry_lr": of_seeds}, {})).iloc[0]
    assert row["yaw_slope"] == pytest.approx(0.5) and row["step_slope"] == pytest.approx(1)
    assert row["yaw_correlation"] == pytest.approx(1) and row["step_correlation"] == pytest.approx(1)
    assert row["yaw_mean_error"] == pytest.approx(-yaws.mean() / 2 - 1)
    assert (row["variant"], row["n"], row["seeds"]) == ("odometry_lr", 7, "0 1")


def test_in_the_synthetic_world_the_depth_tables_pose_nets_are_scored(run):
    assert run.profile.pose_variants == ("odometry_lr", "odometry_dual")
    assert Run("sample").profile.pose_variants == ("lr", "dual") and Run("sample_odometry").profile.pose_variants[0] == "odometry_lr"
    world = Run("tiny")
    assert (world.profile.pose_variants, table_module.sequences(world)) == (("lr", "dual"), ["09", "10"])


def test_where_no_sequence_is_trained_on_the_depth_tables_pose_net_is_scored_and_no_mean_step_is_known(run, net, tmp_path):
    data = {"source": "kitti", "train_drives": ["d"], "odometry_train": [], "odometry_test": ["09"], "hr_size": SIZE}
    (tmp_path / "other").mkdir()
    other = Run(write_profile(tmp_path / "other/other.yaml", "resnet18", {}, data=data, train={"lr": None}), tmp_path)
    Sources.load(run).save(other)
    save(other, net, ["2011_10_03/2011_10_03_drive_0027_sync"], "lr")
    scores = odometry_scores(other, [0])
    table = odometry_table(other, scores).query("frames == 3").set_index("method")
    assert table.loc["Constant velocity", "source"] == "not run" and "no sequence is trained on" in table.loc["Constant velocity", "reason"]
    assert table.loc["Straight ahead", "source"] == "measured" and "sequences" not in table.loc["Ours (LR-Net)", "note"]
    assert {*odometry_claims(other, scores)["b"]} == {"straight", "inverted", "lr"}
