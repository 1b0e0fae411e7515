"""What all tables share: means over seeds, rows that say why they are empty, and honest comparisons."""

import math
import re

import numpy as np
import pandas as pd
import pytest

from dualdepth.evaluation.statistics import Comparison
from dualdepth.run import project_root
from dualdepth.tables import rows as rows_module
from dualdepth.tables.rows import COMPARISON, compared, comparisons, in_words, method_row, over_seeds, paired, readable, tell
from dualdepth.tables.scores import SEEDLESS, Scores, Trained, collect


def frame(values, start=0, column="abs_rel"):
    return pd.DataFrame({column: values}, index=pd.RangeIndex(start, start + len(values), name="image"))


def long(frames):
    """Scores by (variant, seed)."""
    return Scores(pd.concat(frames, names=["variant", "seed"]), {}, {})


@pytest.mark.parametrize(
    ("seeds", "mean", "spread", "images"),
    [
        ([[0.1, 0.3], [0.2, 0.4], [0.9, 0.1, 0.2]], (0.2 + 0.3 + 0.4) / 3, 0.1, 2),  # no more images than each seed has
        ([[0.1, 0.3]], 0.2, math.nan, 2),
    ],
)
def test_a_row_is_the_mean_over_images_then_over_seeds_with_its_spread(seeds, mean, spread, images):
    found = over_seeds(long({("lr", seed): frame(values) for seed, values in enumerate(seeds)}).of("lr"), ["abs_rel"])
    assert found == pytest.approx({"abs_rel": mean, "abs_rel_std": spread, "n": images}, nan_ok=True)


@pytest.mark.parametrize(
    ("variant", "card", "note"),
    [
        ("lr", {"pretrained": True, "steps": 156}, "resnet34, 128x416, ImageNet weights, 156 steps, last epoch"),
        (
            "lr_scratch",
            {"steps": 157, "average": 0.99, "refined": True},
            "resnet34, 128x416, no ImageNet weights, learned with refined poses, 157 steps, weights averaged",
        ),
        ("dual", {"starts_from": {"steps": 156}}, "resnet34, 384x1248, no ImageNet weights, 100 steps after 156 of stage 1, last epoch"),
        ("mobilenet_v2", {"encoder": "mobilenet_v2"}, "mobilenet_v2, 384x1248, no ImageNet weights, 100 steps, last epoch"),
        ("hr_only", {"starts_from": {"steps": 156}}, "384x1248, no ImageNet weights, 100 steps after 156 of stage 1, last epoch"),
    ],
)
def test_a_training_is_described_by_its_card(make_run, cards, variant, card, note):
    cards[variant] = {"encoder": "resnet34"} | card
    assert Trained(make_run("own", kitti=""), variant, 2).describe() == note  # the profile says resnet50 with ImageNet weights


def test_a_row_says_when_scored_drives_were_trained_on(make_run, make_scores, give, cards):
    give(lambda variant, seed: make_scores(0.2))
    drive = "2011_09_26/2011_09_26_drive_0001_sync"
    cards["lr"] = {"drives": [drive, "another"]}
    scores = collect(make_run(), ["lr", "dual"], [0])
    assert method_row(scores, "lr")["leak"] == f"LEAK: trained on {drive}" and method_row(scores, "dual")["leak"] == ""
    # frames of another benchmark: its drives count
    scores = collect(make_run(), ["lr"], [0], reason="", drives=["another"])
    assert method_row(scores, "lr")["leak"] == "LEAK: trained on another"


def test_a_comparison_is_paired_by_image_and_seed():
    b = np.random.default_rng(0).uniform(0.1, 0.9, (3, 40))
    a = b + np.array([[0.01], [0.02], [0.06]])
    scores = long({(name, seed): frame(values[seed]) for name, values in (("dual", a), ("lr", b)) for seed in range(3)})
    (row,) = paired(scores, "dual", "lr", ["abs_rel"])
    assert (row["a"], row["b"], row["metric"], row["n"], row["seeds"], row["better"]) == ("dual", "lr", "abs_rel", 40, 3, "lower")
    assert row["mean_a"] == pytest.approx(a.mean()) and row["mean_b"] == pytest.approx(b.mean())
    np.testing.assert_allclose([row["difference"], row["low"], row["high"]], 0.03)  # each image gains the same
    assert row["spread"] == pytest.approx(np.std([0.01, 0.02, 0.06], ddof=1))
    assert row["in_words"] == "worse by 0.03: the interval over images excludes 0, that over 3 seeds includes 0"


def test_a_method_without_seeds_stands_against_every_seed():
    scores = long({("dual", 0): frame([0.1, 0.2]), ("dual", 1): frame([0.3, 0.4])}).plus("constant", {SEEDLESS: frame([0.5, 0.6])}, "")
    (row,) = paired(scores, "dual", "constant", ["abs_rel"])
    assert [row["mean_a"], row["mean_b"], row["spread"]] == pytest.approx([0.25, 0.55, 0.2 / 2**0.5]) and row["seeds"] == 2


def test_only_images_that_both_have_are_compared():
    # they share images 2, 3 and 4; outside of them lie values that would show
    frames = {("dual", 0): frame([99, 99, 1, 2, 3, 99]), ("dual", 1): frame([99, 1, 2, 3], start=1)}
    frames |= {("lr", 0): frame([5, 5, 5, -99], start=2), ("lr", 1): frame([5, 5, 5, -99, -99], start=2)}
    (row,) = paired(long(frames), "dual", "lr", ["abs_rel"])
    assert [row["mean_a"], row["mean_b"], row["difference"], row["n"]] == [2, 5, -3, 3]


def test_a_pair_that_was_not_trained_has_a_reason_alone(make_run, make_scores, give):
    give(lambda variant, seed: make_scores(0.2))
    run = make_run("own", kitti="train: {lr: , dual: }\n")
    scores = collect(run, ["lr", "dual", "dual_no_sa", "hr_only"], [0])
    pairs = [("dual", "dual_no_sa"), ("dual", "lr"), ("dual_no_sa", "hr_only")]
    table = comparisons(row for pair in pairs for row in paired(scores, *pair))
    assert table["reason"].iloc[0] == "profile own does not train dual_no_sa"
    assert table["reason"].iloc[-1] == "profile own does not train dual_no_sa; profile own does not train hr_only"
    assert table["difference"].notna().tolist() == [False, True, True, False]
    assert table["metric"].tolist() == ["", "abs_rel", "a1", ""] and list(table) == list(comparisons([])) == COMPARISON


def test_trainings_of_one_stage_are_compared_only_if_equally_long_with_every_seed(make_run, make_scores, cards, give):
    give(lambda variant, seed: make_scores(0.2))

    def reasons(*pair, seeds=(0,)):
        return {row.get("reason", "") for row in paired(collect(make_run(), pair, seeds), *pair)}

    cards |= {"lr": {"steps": 30}, "lr_scratch": {"steps": 31}}
    assert reasons("lr", "lr_scratch") == {"lr was trained for 30 steps, lr_scratch for 31"}
    cards["lr"] = {"steps": 31}
    assert reasons("lr", "lr_scratch") == reasons("dual", "lr") == {""}  # the latter are of two stages
    cards["dual_no_sa", 1] = {"steps": 5}
    assert reasons("dual", "dual_no_sa", seeds=(0, 1, 2)) == {"dual was trained for 100 steps, dual_no_sa for 5"}
    assert reasons("dual", "dual_no_sa", seeds=(0, 2)) == {""}


@pytest.mark.parametrize(("images", "reason"), [(0, "0 images"), (1, "1 image"), (2, None)])
def test_fewer_than_two_images_are_not_compared(images, reason):
    row = compared(np.array([[0.1, 0.3][:images]]), np.array([[0.3, 0.7][:images]]), lower_is_better=False)
    assert row["n"] == images and row.get("reason") == reason and ("difference" in row) == (images == 2)


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


@pytest.mark.parametrize("metric", ["abs_rel", "sq_rel", "rmse", "rmse_log", "ate", "t_err", "a1", "a2", "a3", "f1", "lateral_f1"])
def test_the_metric_says_which_way_is_better(metric):
    values = {("dual", 0): frame([0.1, 0.2, 0.3], column=metric), ("lr", 0): frame([0.15, 0.25, 0.35], column=metric)}
    (row,) = paired(long(values), "dual", "lr", [metric])
    share = (metric.startswith("a") and metric[1:].isdigit()) or metric.endswith("f1")
    assert row["better"] == ("higher" if share else "lower")
    assert row["in_words"].startswith("worse" if share else "better")


def test_a_readable_table_has_means_with_their_spread_over_seeds_or_alone_or_nothing():
    nan = np.nan
    table = pd.DataFrame({"abs_rel": [0.20449, 0.5, nan], "abs_rel_std": [0.0061, nan, nan], "a1": [0.9, 0.80004, nan], "n": [8, 8, 0]})
    table = table.assign(variant="lr", reason="", note=["x", "", ""])
    before = table.copy()
    shown = readable(table)
    assert shown["abs_rel"].tolist() == ["0.204 ± 0.006", "0.500", ""]
    assert list(shown.columns) == ["abs_rel", "a1", "n", "note"]
    assert shown["a1"].tolist()[:2] == [0.9, 0.80004]  # has no spread
    assert readable(table, 1)["abs_rel"].tolist() == ["0.2 ± 0.0", "0.5", ""]
    pd.testing.assert_frame_equal(table, before)


def test_comparisons_are_told_a_line_each(capsys):
    rows = [{"of": "Road", "seed": "0", "a": "dual", "b": "lr", "metric": "a1", "in_words": "better"}, {"a": "x", "b": "y", "reason": "no"}]
    tell(comparisons(rows, "seed"))
    assert capsys.readouterr().out == "Road seed 0: dual against lr, a1: better\nx against y: not compared: no\n"


def test_the_table_that_contributing_shows_is_made(make_run, give_maps, capsys):
    """Depth is right on the left, and 20 % too far on the right."""
    truth = np.random.default_rng(0).uniform(4, 40, (3, 30, 60))
    wrong = np.where(np.arange(60) < 40, 1, 1.2)
    give_maps(lambda variant, seed: 1 / (truth * (wrong if variant == "dual" else wrong**2)), list(truth))
    page = (project_root() / "CONTRIBUTING.md").read_text()
    code = next(block for block in re.findall(r"```python\n(.*?)```", page, re.DOTALL) if "def thirds" in block)
    names = {name: getattr(rows_module, name) for name in ("method_row", "tell", "comparisons", "paired")}
    shown = []
    exec(code, names | {"run": make_run(frames=3), "seeds": [0], "collect": collect, "pd": pd, "show": shown.append})
    table = shown[0].set_index(["third", "variant"])["abs_rel"]
    assert len(table) == 6 and table["left", "dual"] == pytest.approx(table["middle", "dual"])
    assert table["left", "dual"] < table["right", "dual"] < table["right", "lr"] - 0.1
    assert "right: dual against lr, abs_rel: better by " in capsys.readouterr().out
