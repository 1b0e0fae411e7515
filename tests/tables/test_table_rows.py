"""What all tables share: means over seeds, rows that say why they are empty, and honest comparisons."""

import json
import math

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper
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
    with_paper,
)
from dualdepth.training.weights import load_card

KITTI = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n"


def frame(values, start=0, column="abs_rel"):
    return pd.DataFrame({column: values}, index=pd.RangeIndex(start, start + len(values), name="image"))


def test_a_row_is_the_mean_over_images_then_over_seeds_with_its_spread():
    row = mean_row([frame([0.1, 0.3]), frame([0.2, 0.4]), frame([0.9, 0.1, 0.2])], ["abs_rel"])
    assert row["abs_rel"] == pytest.approx((0.2 + 0.3 + 0.4) / 3)
    assert row["abs_rel_std"] == pytest.approx(0.1)
    assert row["n"] == 2  # no more images than each seed has


def test_a_row_of_one_seed_has_no_spread():
    row = mean_row([frame([0.1, 0.3])], ["abs_rel"])
    assert row["abs_rel"] == pytest.approx(0.2) and math.isnan(row["abs_rel_std"])


def test_a_row_without_images_has_no_numbers():
    row = mean_row([frame([])], ["abs_rel"])
    assert math.isnan(row["abs_rel"]) and math.isnan(row["abs_rel_std"]) and row["n"] == 0
    row = mean_row([frame([0.1, 0.3]), frame([])], ["abs_rel"])
    assert math.isnan(row["abs_rel"]) and row["n"] == 0


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


def test_the_note_says_that_the_list_is_incomplete(make_run):
    run = make_run("own", text=KITTI, frames=25, listed=697)
    assert training_note(run, "lr", 0).endswith("last epoch, 25 of 697 frames")


@pytest.mark.parametrize("name", ["main", "ablation", "distance", "sharpness", "backbone"])
def test_the_papers_rows_stay_as_they_are_above_ours(name, check_paper_rows):
    expected = paper.table(name)
    first = expected.columns[0]
    table = with_paper(name, [{first: "ours", "abs_rel": 0.5, "n": 8, "seeds": "0", "note": "", "source": "measured"}])
    check_paper_rows(table, expected)
    assert table.iloc[-1][first] == "ours" and table.iloc[-1]["source"] == "measured" and len(table) == len(expected) + 1
    assert table["n"].dtype == "Int64" and table["n"].iloc[-1] == 8
    assert table["note"].eq("").all() and table["seeds"].iloc[:-1].eq("").all()


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


@pytest.mark.parametrize(
    ("pair", "steps", "words"),
    [
        (("dual", "dual_no_sa"), {"dual": 100, "dual_no_sa": 5}, "not compared: dual was trained for 100 steps, dual_no_sa for 5"),
        (("lr", "lr_scratch"), {"lr": 30, "lr_scratch": 31}, "not compared: lr was trained for 30 steps, lr_scratch for 31"),
    ],
)
def test_trainings_of_one_stage_are_compared_only_if_equally_long(make_run, make_scores, steps_of, pair, steps, words):
    def compared():
        return compare_trainings(make_run(), [pair], [0], scores=lambda run, variant, seed: make_scores(0.2))

    steps_of |= steps
    table = compared()
    assert table["in_words"].tolist() == [words]
    assert table[["mean_a", "mean_b", "difference", "low", "high", "spread", "n"]].isna().all(axis=None)
    steps_of |= dict.fromkeys(pair, 77)
    assert compared()["difference"].notna().all()


def test_trainings_of_two_stages_are_compared_whatever_their_length(make_run, make_scores, steps_of):
    steps_of |= {"dual": 40, "lr": 2000}
    table = compare_trainings(make_run(), [("dual", "lr")], [0], scores=lambda run, variant, seed: make_scores(0.2))
    assert table["difference"].notna().tolist() == [True, True]


def test_the_steps_of_every_seed_count(make_run, make_scores, steps_of):
    steps_of["dual_no_sa", 1] = 5
    pair = [("dual", "dual_no_sa")]

    def compared(seeds):
        return compare_trainings(make_run(), pair, seeds, scores=lambda run, variant, seed: make_scores(0.2))

    words = compared([0, 1, 2])["in_words"]
    assert len(words) == 1 and words[0].startswith("not compared: dual was trained for 100 steps, dual_no_sa for ")
    assert compared([0, 2])["difference"].notna().all()


def test_a_table_of_comparisons_has_its_columns_whether_or_not_there_is_anything_to_compare(make_run, make_scores):
    run = make_run("own", text=KITTI + "train: {lr: , dual: }\n")
    for pairs in ([("dual", "lr")], [("dual", "dual_no_sa")], []):
        table = compare_trainings(run, pairs, [0], scores=lambda run, variant, seed: make_scores(0.2))
        assert list(table.columns) == COMPARISON
    expected = ["a", "b", "metric", "mean_a", "mean_b", "difference", "low", "high", "spread", "seeds", "n", "in_words"]
    assert expected == COMPARISON


@pytest.mark.parametrize(("images", "words"), [(1, "not compared: 1 image"), (0, "not compared: 0 image")])
def test_fewer_than_two_images_are_not_compared(images, words):
    values = [np.full(images, 0.2)] * 3
    row = comparison_row(values, values, lower_is_better=True)
    assert row["n"] == images and row["in_words"].startswith(words)
    assert set(row) == {"n", "in_words"}


def test_two_images_are_compared():
    row = comparison_row([np.array([0.1, 0.3])], [np.array([0.3, 0.7])], lower_is_better=False)
    assert row["n"] == 2 and row["difference"] == pytest.approx(-0.3) and row["in_words"].startswith("worse by 0.3:")


def comparison(difference, low, high, spread=math.nan, seeds=1):
    return Comparison(0.0, 0.0, difference, low, high, spread, seeds)


def test_less_error_is_better():
    assert in_words(comparison(-0.02, -0.03, -0.01), True).startswith("better by 0.02:")
    assert in_words(comparison(0.02, 0.01, 0.03), True).startswith("worse by 0.02:")


def test_more_of_a_share_or_score_is_better():
    assert in_words(comparison(0.02, 0.01, 0.03), False).startswith("better by 0.02:")
    assert in_words(comparison(-0.02, -0.03, -0.01), False).startswith("worse by 0.02:")


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


def test_words_say_which_interval_excludes_zero():
    assert in_words(comparison(-0.068, -0.08, -0.01, 0.03, 3), True) == (
        "better by 0.068: the interval over images excludes 0, that over 3 seeds includes 0"
    )
    assert in_words(comparison(-0.068, -0.08, 0.01, 0.02, 3), True) == (
        "better by 0.068: the interval over images includes 0, that over 3 seeds excludes 0"
    )


def test_words_of_one_seed_claim_no_spread():
    assert in_words(comparison(-0.02, -0.03, -0.01), True) == "better by 0.02: the interval over images excludes 0, one seed"


@pytest.mark.parametrize("lower_is_better", [True, False])
def test_no_difference_is_neither_better_nor_worse(lower_is_better):
    assert in_words(comparison(0.0, 0.0, 0.0, 0.0, 3), lower_is_better) == "the same"


def test_a_readable_table_has_means_with_their_spread_over_seeds_or_alone_or_nothing():
    table = pd.DataFrame(
        {
            "method": ["ours", "one seed", "not run"],
            "abs_rel": [0.20449, 0.5, np.nan],
            "abs_rel_std": [0.0061, np.nan, np.nan],
            "a1": [0.9, 0.80004, np.nan],
            "a1_std": [0.01, 0.02, np.nan],
            "n": [8, 8, 0],
        }
    )
    before = table.copy()
    shown = readable(table, ["abs_rel"])
    assert shown["abs_rel"].tolist() == ["0.204 ± 0.006", "0.500", ""]
    assert list(shown.columns) == ["method", "abs_rel", "a1", "n"]
    assert shown["a1"].tolist()[:2] == [0.9, 0.80004]  # not asked for
    shown = readable(table, ["abs_rel", "a1"], 1)
    assert shown["abs_rel"].tolist() == ["0.2 ± 0.0", "0.5", ""]
    assert shown["a1"].tolist() == ["0.9 ± 0.0", "0.8 ± 0.0", ""]
    pd.testing.assert_frame_equal(table, before)


def test_a_column_that_has_no_spread_is_readable_too():
    table = pd.DataFrame({"ratio": [1.25, np.nan]}, index=[7, 3])
    assert readable(table, ["ratio"], 2)["ratio"].tolist() == ["1.25", ""]


def test_the_note_says_when_scored_drives_were_trained_on(make_run, cards):
    drive = "2011_09_26/2011_09_26_drive_0001_sync"
    cards["lr"] = {"drives": [drive, "another"]}
    assert rows.training_note(make_run(), "lr", 0).endswith(f", LEAK: trained on {drive}")
    assert "LEAK" not in rows.training_note(make_run(), "dual", 0)
    # frames of another benchmark: its drives count, and KITTI's incomplete list does not
    assert "LEAK: trained on another" in rows.training_note(make_run(listed=9), "lr", 0, drives=["another"])
    assert "frames" not in rows.training_note(make_run(listed=9), "lr", 0, drives=[])
