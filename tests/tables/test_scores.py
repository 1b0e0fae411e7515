"""Predictions of a training: scaled as they are scored, kept while they fit, made anew when anything they hang on changes."""

import json
from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pandas as pd
import pytest

from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import Protocol, evaluate, valid_pixels
from dualdepth.files import write_json
from dualdepth.run import Run, Sources
from dualdepth.settings import Evaluation
from dualdepth.tables import scores as module
from dualdepth.tables.main import BASELINES, baseline_depths
from dualdepth.tables.scores import Scored, Trained

DRIVES = ("2011_09_26/2011_09_26_drive_0001_sync", "2011_09_26/2011_09_26_drive_0002_sync")
FRAMES = [[DRIVES[0], 0, "image_02"], [DRIVES[0], 5, "image_02"], [DRIVES[1], 3, "image_02"]]
SIZE = (40, 60)


def truths(seed=0):
    rng = np.random.default_rng(seed)
    return [np.where(rng.random(SIZE) < 0.4, rng.uniform(2, 90, SIZE), 0).astype(np.float32) for _ in range(3)]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run of `tiny` with three scored frames and weights of LR-Net; `run.predicted` lists the weights that were asked for maps.

    The maps hang on the bytes of the weights alone.
    """
    run = Run("tiny", tmp_path)
    run.prepared.mkdir(parents=True)
    write_json(run.prepared / "test_frames.json", {"frames": FRAMES, "listed": 3})
    Sources(kitti_root=tmp_path, test_list=tmp_path, labels_root=run.work / "miniature" / "labels").save(run)
    save_ground_truth(run.prepared / "ground_truth.npz", truths())
    run.weights("lr", 0).parent.mkdir(parents=True)
    run.weights("lr", 0).write_bytes(b"1")
    write_json(run.weights("lr", 0).with_suffix(".json"), {"drives": ["2011_09_26/2011_09_26_drive_0099_sync"]})
    run.predicted = []

    def predict(weights, paths):
        assert paths == ["a", "b", "c"]
        run.predicted.append(weights)
        return np.random.default_rng(weights[0]).uniform(0.02, 3, (3, 12, 20)).astype(np.float32)

    monkeypatch.setattr(Scored, "paths", ["a", "b", "c"])
    monkeypatch.setattr(module, "load", lambda path, *_: SimpleNamespace(disparities=partial(predict, path.read_bytes())))
    return run


def training(run, variant="lr", seed=0):
    """As another notebook sees it, which has read nothing yet."""
    module._made.cache_clear()
    return Trained(run, variant, seed)


def evaluate_with(run, **changes):
    """Change evaluation settings of a run's profile."""
    settings = Evaluation(**(run.profile.evaluation.model_dump() | changes))
    run.profile = run.profile.model_copy(update={"evaluation": settings})


@pytest.mark.parametrize("settings", [{"resize": "depth"}, {"resize": "disparity"}, {"min_depth": 20, "max_depth": 60}], ids=str)
def test_depth_is_the_depth_that_was_scored(run, settings):
    evaluate_with(run, **settings)
    predictions, scored = training(run), np.random.default_rng(b"1"[0]).uniform(0.02, 3, (3, 12, 20)).astype(np.float32)
    for image, truth in enumerate(truths()):
        pixels = valid_pixels(scored[image], truth, Protocol(kind="disparity", **settings))
        depth = predictions.depth(image)
        assert depth.shape == SIZE
        np.testing.assert_allclose(depth.ravel()[pixels.index], pixels.prediction, rtol=1e-5)
        assert np.median(depth.ravel()[pixels.index]) == pytest.approx(np.median(pixels.ground_truth), rel=1e-5)


def test_depth_can_be_had_at_any_size_with_the_same_ratio(run):
    predictions = training(run)
    ratio = predictions.scores.loc[1, "scale_ratio"]
    np.testing.assert_allclose(predictions.depth(1, (12, 20)), np.clip(ratio / predictions.disparities[1], 1e-3, 80), rtol=1e-5)
    assert predictions.depth(1, (7, 100)).shape == (7, 100)


def test_scores_are_those_of_the_protocol_in_the_profile(run):
    evaluate_with(run, crop="none", max_depth=50.0)
    scores = training(run).scores
    expected = evaluate(np.load(run.training("lr", 0) / "disparities.npy"), truths(), kind="disparity", crop="none", max_depth=50.0)
    pd.testing.assert_frame_equal(scores, expected)
    assert np.load(run.training("lr", 0) / "disparities.npy").dtype == np.float32


def test_what_was_scored_is_kept_and_read_again(run):
    first, second = training(run).scores, training(run).scores
    assert run.predicted == [b"1"]
    pd.testing.assert_frame_equal(second, first, rtol=1e-12)
    assert second.index.name == "image"
    run.profile = run.profile.model_copy(update={"seeds": [0, 1], "about": "another"})  # which shapes no scores
    predictions = training(run)
    assert run.predicted == [b"1"] and predictions.disparities.shape == (3, 12, 20)


@pytest.mark.parametrize("change", ["weights", "truth", "settings", "code", "damaged stamp", "no stamp"])
def test_whatever_else_shapes_the_scores_makes_them_anew(run, monkeypatch, change):
    old = training(run).scores
    stamp = run.training("lr", 0) / "per_image.json"
    if change == "weights":
        run.weights("lr", 0).write_bytes(b"2")
    elif change == "truth":
        save_ground_truth(run.prepared / "ground_truth.npz", truths(seed=1))
    elif change == "settings":
        evaluate_with(run, max_depth=30.0)
    elif change == "code":
        monkeypatch.setattr(module, "code_digest", lambda step: "another")
    elif change == "damaged stamp":
        stamp.write_text("{")
    else:
        stamp.unlink()
    new = training(run).scores
    assert (new["abs_rel"] != old["abs_rel"]).any() == (change in ("weights", "truth", "settings"))
    pd.testing.assert_frame_equal(training(run).scores, new, rtol=1e-12)
    again = {"weights": [b"2"], "truth": [b"1"], "code": [b"1"]}.get(change, [])  # else the disparities fit still
    assert run.predicted == [b"1", *again]
    assert json.loads(stamp.read_text())["ground_truth.npz"]


def test_frames_of_an_own_camera_are_predicted_but_not_scored(run, monkeypatch):
    own = run.profile.data.model_copy(update={"source": "own"})
    run.profile = run.profile.model_copy(update={"data": own})
    monkeypatch.setattr(module, "evaluate_parts", None)
    scores = training(run).scores
    assert scores["abs_rel"].isna().all() and len(scores) == 3
    pd.testing.assert_frame_equal(training(run).scores, scores, check_dtype=False, check_index_type=False)
    assert run.predicted == [b"1"]
    depth = training(run).depth(1, (12, 20))
    assert depth.shape == (12, 20) and np.median(depth) == pytest.approx(10, rel=0.01)


@pytest.mark.parametrize(("variant", "notebook"), [("lr", "03_train_lr"), ("lr_scratch", "03_train_lr"), ("dual", "04_train_hr")])
def test_a_training_that_is_not_there_names_its_notebook_variant_and_seed(run, variant, notebook):
    with pytest.raises(InputError, match=f"model.safetensors is missing: run notebook {notebook}, variant {variant}, seed 4, with profile"):
        _ = training(run, variant, 4).disparities


def test_the_scored_frames_keep_the_order_of_the_truth_and_an_incomplete_list_is_said(run):
    assert [*map(list, Scored(run).frames)] == FRAMES and Scored(run).note == ""
    write_json(run.prepared / "test_frames.json", {"frames": FRAMES, "listed": 697})
    assert Scored(run).note == "3 of 697 frames"


def test_the_synthetic_world_has_exact_depth_and_labels_of_each_frame_and_real_frames_have_none(run):
    for kind, suffix in (("dense_depth", ".npy"), ("labels", ".png")):
        folder = run.work / "miniature" / kind / DRIVES[1].split("/")[1]
        folder.mkdir(parents=True)
        values = np.array([[1, 5], [0, 8]], np.uint8)
        path = str(folder / f"0000000003{suffix}")
        np.save(path, values + 0.5) if suffix == ".npy" else cv2.imwrite(path, values)
    np.testing.assert_array_equal(Scored(run).exact_depth(2), [[1.5, 5.5], [0.5, 8.5]])
    np.testing.assert_array_equal(Scored(run).label_map(2), [[1, 5], [0, 8]])
    run.profile = run.profile.model_copy(update={"world": None})
    Sources.load(run)._replace(labels_root=None).save(run)
    assert Scored(run).exact_depth(2) is None and Scored(run).label_map(2) is None


def test_baselines_are_predicted_from_the_other_drives_or_from_training_frames_or_not_at_all(run):
    by_drive = {name: baseline_depths(run, name) for name in BASELINES}
    assert all(len(maps) == 3 and maps[0].shape == SIZE and "all other drives" in note for maps, note in by_drive.values())
    save_ground_truth(run.prepared / "baseline_truth.npz", truths(seed=5))
    fitted, note = baseline_depths(run, "mean_map")
    assert np.abs(fitted[0] - by_drive["mean_map"][0][0]).max() > 0.1 and "training-side" in note
    (run.prepared / "baseline_truth.npz").unlink()
    frames = [[DRIVES[0], i, "image_02"] for i in range(3)]
    write_json(run.prepared / "test_frames.json", {"frames": frames, "listed": 3})
    module._made.cache_clear()
    assert baseline_depths(run, "mean_map")[0] is None


def test_weights_that_saw_a_test_drive_are_refused_unless_allowed(run):
    write_json(run.weights("lr", 0).with_suffix(".json"), {"drives": [DRIVES[1]]})
    with pytest.raises(InputError, match=rf"model\.safetensors: was trained on {DRIVES[1]}"):
        _ = training(run).disparities
    Sources.load(run)._replace(allow_leak=True).save(run)
    assert len(training(run).scores) == 3
    Sources.load(run)._replace(allow_leak=False).save(run)
    with pytest.raises(InputError, match="was trained on"):  # though the scores are kept
        _ = training(run).scores
