"""What all tables share: means over seeds, rows that say why they are empty, and honest comparisons."""

import math

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper
from dualdepth.checkpoints import load_card
from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.statistics import Comparison
from dualdepth.tables import rows
from dualdepth.tables.rows import compare_trainings, in_words, mean_row, training_note, training_row, with_paper

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


def test_all_seven_metrics_are_in_a_trainings_row(make_run, make_scores):
    asked = []

    def scores(run, variant, seed):
        asked.append((variant, seed))
        return make_scores(0.2 + 0.1 * seed)

    row = training_row(make_run(), "dual", [0, 2], scores=scores)
    assert asked == [("dual", 0), ("dual", 2)]
    assert row["variant"] == "dual" and row["source"] == "measured"
    assert row["seeds"] == "0 2" and row["n"] == 6
    assert row["note"].endswith("last epoch, 100 steps")
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
        ("lr", "resnet50, 128x416, ImageNet weights, last epoch"),
        ("lr_scratch", "resnet50, 128x416, no ImageNet weights, last epoch"),
        ("dual", "resnet50, 384x1248, ImageNet weights, last epoch"),
        ("mobilenet_v2", "mobilenet_v2, 384x1248, ImageNet weights, last epoch"),
        ("hr_only", "384x1248, no ImageNet weights, last epoch"),
    ],
)
def test_the_note_says_backbone_size_and_first_weights(make_run, variant, note):
    assert training_note(make_run("own", text=KITTI), variant) == note


def test_the_note_says_that_the_list_is_incomplete(make_run):
    run = make_run("own", text=KITTI, frames=25, listed=697)
    assert training_note(run, "lr").endswith("last epoch, 25 of 697 frames")


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
    assert row["in_words"] == "worse by 0.030: outside the interval over images, outside the spread over 3 seeds"


def test_only_images_that_both_have_are_compared(make_run):
    # they share images 2, 3 and 4; outside of them lie values that would show
    frames = {("dual", 0): frame([99, 99, 1, 2, 3]), ("dual", 1): frame([1, 2, 3, 99], start=2)}
    frames |= {("lr", 0): frame([5, 5, 5, -99], start=2), ("lr", 1): frame([-99, 5, 5, 5, -99], start=1)}
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


def test_the_number_of_steps_is_read_from_the_trainings_card(make_run, monkeypatch):
    monkeypatch.setattr(rows, "load_card", load_card)
    run = make_run()
    card = run.training("dual", 2) / "model.json"
    card.parent.mkdir(parents=True)
    card.write_text('{"steps": 396}')
    assert rows.steps(run, "dual", 2) == 396


def comparison(difference, low, high, spread=math.nan, seeds=1):
    return Comparison(0.0, 0.0, difference, low, high, spread, seeds)


@pytest.mark.parametrize("metric", ["abs_rel", "sq_rel", "rmse", "rmse_log"])
def test_less_error_is_better(metric):
    assert in_words(comparison(-0.02, -0.03, -0.01), metric).startswith("better by 0.020:")
    assert in_words(comparison(0.02, 0.01, 0.03), metric).startswith("worse by 0.020:")


@pytest.mark.parametrize("metric", ["a1", "a2", "a3", "f1", "lateral_f1"])
def test_more_of_a_share_or_score_is_better(metric):
    assert in_words(comparison(0.02, 0.01, 0.03), metric).startswith("better by 0.020:")
    assert in_words(comparison(-0.02, -0.03, -0.01), metric).startswith("worse by 0.020:")


def test_words_say_what_a_difference_stands_outside_of():
    assert in_words(comparison(-0.02, -0.03, 0.01, 0.01, 3), "abs_rel") == (
        "better by 0.020: inside the interval over images, outside the spread over 3 seeds"
    )
    assert in_words(comparison(-0.02, -0.03, -0.01, 0.05, 2), "abs_rel") == (
        "better by 0.020: outside the interval over images, inside the spread over 2 seeds"
    )


def test_words_of_one_seed_claim_no_spread():
    words = in_words(comparison(-0.02, -0.03, -0.01), "abs_rel")
    assert words == "better by 0.020: outside the interval over images, one seed, no spread known"


def test_no_difference_is_neither_better_nor_worse():
    assert in_words(comparison(0.0, 0.0, 0.0), "a1") == "the same by 0.000: inside the interval over images, one seed, no spread known"
