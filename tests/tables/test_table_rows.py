"""What all tables share: means over seeds, rows that say why they are empty, and honest comparisons."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.statistics import Comparison
from dualdepth.tables import rows
from dualdepth.tables.rows import (
    COMPARISON,
    compare_trainings,
    comparison_row,
    in_words,
    mean_row,
    readable,
    training_note,
    training_row,
)
from dualdepth.training.weights import load_card

KITTI = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n"


def frame(values, start=0, column="abs_rel"):
    return pd.DataFrame({column: values}, index=pd.RangeIndex(start, start + len(values), name="image"))


@pytest.mark.parametrize(
    ("seeds", "mean", "spread", "images"),
    [
        ([[0.1, 0.3], [0.2, 0.4], [0.9, 0.1, 0.2]], (0.2 + 0.3 + 0.4) / 3, 0.1, 2),  # no more images than each seed has
        ([[0.1, 0.3]], 0.2, math.nan, 2),
        ([[]], math.nan, math.nan, 0),
        ([[0.1, 0.3], []], math.nan, math.nan, 0),
    ],
)
def test_a_row_is_the_mean_over_images_then_over_seeds_with_its_spread(seeds, mean, spread, images):
    row = mean_row([frame(values) for values in seeds], ["abs_rel"])
    assert row == pytest.approx({"abs_rel": mean, "abs_rel_std": spread, "n": images}, nan_ok=True)


def test_all_seven_metrics_are_in_a_trainings_row(make_run, make_scores):
    asked = []

    def scores(run, variant, seed):
        asked.append((variant, seed))
        return make_scores(0.2 + 0.1 * seed)

    row = training_row(make_run(), "dual", [0, 2], scores=scores)
    assert asked == [("dual", 0), ("dual", 2)]
    assert row["variant"] == "dual" and row["source"] == "measured"
    assert row["seeds"] == "0 2" and row["n"] == 6
    assert row["note"] == "resnet18, 192x576, no ImageNet weights, 100 steps, last epoch"
    for metric in METRICS:
        assert row[metric] == pytest.approx(0.3)
        assert row[f"{metric}_std"] == pytest.approx(0.1 * math.sqrt(2))


def test_a_variant_that_is_not_trained_says_so_and_has_no_numbers(make_run):
    def scores(run, variant, seed):
        raise AssertionError("asked for scores of a network that does not exist")

    run = make_run("own", text=KITTI + "train: {lr: }\n")
    row = training_row(run, "dual", [0], scores=scores)
    assert row == {"variant": "dual", "source": "measured", "note": "not run: profile own does not train it"}


@pytest.mark.parametrize(
    ("variant", "note"),
    [
        ("lr", "resnet34, 128x416, ImageNet weights, 156 steps, last epoch"),
        ("lr_scratch", "resnet34, 128x416, no ImageNet weights, 157 steps, last epoch"),
        ("dual", "resnet34, 384x1248, ImageNet weights, 52 steps after 156 of stage 1, last epoch"),
        ("mobilenet_v2", "mobilenet_v2, 384x1248, ImageNet weights, 50 steps, last epoch"),
        ("hr_only", "384x1248, no ImageNet weights, 51 steps after 156 of stage 1, last epoch"),
    ],
)
def test_the_note_says_backbone_size_first_weights_and_steps_as_the_card_has_them(make_run, monkeypatch, variant, note):
    monkeypatch.setattr(rows, "load_card", load_card)
    run = make_run("own", text=KITTI)  # which says other things: resnet50 with ImageNet weights
    start = {"variant": "lr", "seed": 2, "steps": 156}
    cards = {
        "lr": {"encoder": "resnet34", "pretrained": True, "steps": 156, "starts_from": None},
        "lr_scratch": {"encoder": "resnet34", "pretrained": False, "steps": 157, "starts_from": None},
        "dual": {"encoder": "resnet34", "pretrained": True, "steps": 52, "starts_from": start},
        "mobilenet_v2": {"encoder": "mobilenet_v2", "pretrained": True, "steps": 50, "starts_from": None},
        "hr_only": {"encoder": "resnet34", "pretrained": False, "steps": 51, "starts_from": start},
    }
    card = run.training(variant, 2) / "model.json"
    card.parent.mkdir(parents=True)
    card.write_text(json.dumps(cards[variant] | {"drives": []}))
    assert training_note(run, variant, 2) == note


def test_a_comparison_is_paired_by_image_and_seed(make_run):
    b = np.random.default_rng(0).uniform(0.1, 0.9, (3, 40))
    a = b + np.array([[0.01], [0.02], [0.06]])

    def scores(run, variant, seed):
        return frame({"dual": a, "lr": b}[variant][seed])

    row = compare_trainings(make_run(), [("dual", "lr")], [0, 1, 2], metrics=["abs_rel"], scores=scores).loc[0]
    assert (row["a"], row["b"], row["metric"], row["n"], row["seeds"]) == ("dual", "lr", "abs_rel", 40, 3)
    assert row["mean_a"] == pytest.approx(a.mean()) and row["mean_b"] == pytest.approx(b.mean())
    np.testing.assert_allclose(row[["difference", "low", "high"]].astype(float), 0.03)  # each image gains the same
    assert row["spread"] == pytest.approx(np.std([0.01, 0.02, 0.06], ddof=1))
    assert row["in_words"] == "worse by 0.03: the interval over images excludes 0, that over 3 seeds includes 0"


def test_only_images_that_both_have_are_compared(make_run):
    # they share images 2, 3 and 4; outside of them lie values that would show
    frames = {("dual", 0): frame([99, 99, 1, 2, 3, 99]), ("dual", 1): frame([99, 1, 2, 3], start=1)}
    frames |= {("lr", 0): frame([5, 5, 5, -99], start=2), ("lr", 1): frame([5, 5, 5, -99, -99], start=2)}
    table = compare_trainings(make_run(), [("dual", "lr")], [0, 1], metrics=["abs_rel"], scores=lambda run, *key: frames[key])
    assert table.loc[0, ["mean_a", "mean_b", "difference", "n"]].tolist() == [2, 5, -3, 3]


def test_a_pair_that_was_not_trained_has_words_alone(make_run, make_scores):
    run = make_run("own", text=KITTI + "train: {lr: , dual: }\n")
    pairs = [("dual", "dual_no_sa"), ("dual", "lr"), ("lr_scratch", "dual_scratch")]
    table = compare_trainings(run, pairs, [0], scores=lambda run, variant, seed: make_scores(0.2))
    assert table["in_words"].iloc[0] == "not run: profile own does not train dual_no_sa"
    assert table["in_words"].iloc[-1] == "not run: profile own does not train lr_scratch nor dual_scratch"
    assert table["difference"].notna().tolist() == [False, True, True, False]
    assert table["metric"].tolist() == ["", "abs_rel", "a1", ""]


def test_trainings_of_one_stage_are_compared_only_if_equally_long_with_every_seed(make_run, make_scores, cards):
    def compared(*pair, seeds=(0,)):
        return compare_trainings(make_run(), [pair], seeds, scores=lambda run, variant, seed: make_scores(0.2))

    cards |= {"lr": {"steps": 30}, "lr_scratch": {"steps": 31}}
    table = compared("lr", "lr_scratch")
    assert table["in_words"].tolist() == ["not compared: lr was trained for 30 steps, lr_scratch for 31"]
    assert table[["mean_a", "mean_b", "difference", "low", "high", "spread", "n"]].isna().all(axis=None)
    cards["lr"] = {"steps": 31}
    assert compared("lr", "lr_scratch")["difference"].notna().all() and compared("dual", "lr")["difference"].notna().all()  # two stages
    cards["dual_no_sa", 1] = {"steps": 5}
    assert compared("dual", "dual_no_sa", seeds=(0, 1, 2))["in_words"].tolist() == [
        "not compared: dual was trained for 100 steps, dual_no_sa for 5"
    ]
    assert compared("dual", "dual_no_sa", seeds=(0, 2))["difference"].notna().all()


def test_a_table_of_comparisons_has_its_columns_even_with_nothing_to_compare(make_run):
    assert list(compare_trainings(make_run(), [], [0]).columns) == COMPARISON


@pytest.mark.parametrize(("images", "words"), [(0, "not compared: 0 image"), (1, "not compared: 1 image"), (2, "worse by 0.3:")])
def test_fewer_than_two_images_are_not_compared(images, words):
    row = comparison_row([np.array([0.1, 0.3][:images])], [np.array([0.3, 0.7][:images])], lower_is_better=False)
    assert row["n"] == images and row["in_words"].startswith(words) and ("difference" in row) == (images == 2)


@pytest.mark.parametrize(
    ("numbers", "words"),
    [
        ((-0.068, -0.08, -0.01, 0.03, 3), "by 0.068: the interval over images excludes 0, that over 3 seeds includes 0"),
        ((0.068, -0.01, 0.08, 0.02, 3), "by 0.068: the interval over images includes 0, that over 3 seeds excludes 0"),
        ((-0.02, -0.03, -0.01, math.nan, 1), "by 0.02: the interval over images excludes 0, one seed"),
        ((0.0, 0.0, 0.0, 0.0, 3), ""),
    ],
)
def test_words_say_which_is_better_and_which_interval_excludes_zero(numbers, words):
    """Less error is better, and more of a share or score."""
    said = ("better ", "worse ") if numbers[0] < 0 else ("worse ", "better ")
    for lower_is_better, verdict in zip((True, False), said):
        assert in_words(Comparison(0.0, 0.0, *numbers), lower_is_better) == (verdict + words if words else "the same")


@pytest.mark.parametrize(
    ("metric", "verdict"),
    [
        *((m, "better") for m in ("abs_rel", "sq_rel", "rmse", "rmse_log")),
        *((m, "worse") for m in ("a1", "a2", "a3", "f1", "lateral_f1")),
    ],
)
def test_the_metric_says_which_way_is_better(make_run, metric, verdict):
    def scores(run, variant, seed):
        return frame(np.array([0.1, 0.2, 0.3]) + 0.05 * (variant == "lr"), column=metric)

    row = compare_trainings(make_run(), [("dual", "lr")], [0], metrics=[metric], scores=scores).loc[0]
    assert row["in_words"] == f"{verdict} by 0.05: the interval over images excludes 0, one seed"


def test_a_readable_table_has_means_with_their_spread_over_seeds_or_alone_or_nothing():
    nan = np.nan
    table = pd.DataFrame({"abs_rel": [0.20449, 0.5, nan], "abs_rel_std": [0.0061, nan, nan], "a1": [0.9, 0.80004, nan], "n": [8, 8, 0]})
    before = table.copy()
    shown = readable(table, ["abs_rel"])
    assert shown["abs_rel"].tolist() == ["0.204 ± 0.006", "0.500", ""]
    assert list(shown.columns) == ["abs_rel", "a1", "n"]
    assert shown["a1"].tolist()[:2] == [0.9, 0.80004]  # not asked for
    shown = readable(table, ["abs_rel", "a1"], 1)
    assert shown["abs_rel"].tolist() == ["0.2 ± 0.0", "0.5", ""]
    assert shown["a1"].tolist() == ["0.9", "0.8", ""]
    pd.testing.assert_frame_equal(table, before)


def test_the_note_says_that_the_list_is_incomplete_and_when_scored_drives_were_trained_on(make_run, cards):
    drive = "2011_09_26/2011_09_26_drive_0001_sync"
    cards["lr"] = {"drives": [drive, "another"]}
    assert training_note(make_run(), "lr", 0).endswith(f", LEAK: trained on {drive}")
    assert "LEAK" not in training_note(make_run(), "dual", 0)
    assert training_note(make_run(frames=25, listed=697), "dual", 0).endswith("last epoch, 25 of 697 frames")
    # frames of another benchmark: its drives count, and KITTI's incomplete list does not
    assert "LEAK: trained on another" in training_note(make_run(listed=9), "lr", 0, drives=["another"])
    assert "frames" not in training_note(make_run(listed=9), "lr", 0, drives=[])
