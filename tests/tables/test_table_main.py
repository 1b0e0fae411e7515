"""The main table: the paper's rows untouched, ours beside them, and what could not be run said so."""

import numpy as np
import pytest

from dualdepth import paper
from dualdepth.evaluation.depth import METRICS
from dualdepth.tables import main
from dualdepth.tables.main import compare_with_baselines, main_table


@pytest.fixture
def run(make_run, make_scores, give, monkeypatch):
    """A run of `tiny` whose scores are given."""

    def scores(run, variant, seed):
        return make_scores({"lr": 0.2, "dual": 0.1}[variant] + 0.02 * seed)

    give(scores)
    monkeypatch.setattr(main, "score_training", scores)
    baselines = {"constant": make_scores(0.5), "row_mean": make_scores(0.4), "mean_map": make_scores(0.3)}
    monkeypatch.setattr(main, "score_baselines", lambda run: baselines)
    monkeypatch.setattr(main, "score_untrained", lambda run, seed: make_scores(0.6 + 0.02 * seed))
    return make_run()


def test_a_row_is_the_mean_over_seeds_with_its_spread_and_names_the_seeds(run):
    measured = main_table(run, [0, 3]).query("source == 'measured'").set_index("method")
    means = {"LR-Net, untrained": 0.63, "LR-Net": 0.23, "LR-Net + HR-Net, w/ SA": 0.13}
    for method, mean in means.items():
        row = measured.loc[method]
        assert row["seeds"] == "0 3"
        for metric in METRICS:
            assert row[metric] == pytest.approx(mean), (method, metric)
            assert row[f"{metric}_std"] == pytest.approx(0.06 / np.sqrt(2)), (method, metric)


def test_baselines_have_their_scores_and_know_no_seed(run):
    measured = main_table(run, [0, 3]).query("source == 'measured'").set_index("method")
    baselines = {"Train set mean": 0.3, "Per-row mean": 0.4, "Constant depth": 0.5}
    for method, value in baselines.items():
        assert measured.loc[method, "abs_rel"] == pytest.approx(value)
        assert measured.loc[method, "seeds"] == "" and measured.loc[method, "supervision"] == "Depth"


def test_the_data_set_and_the_number_of_images_are_named(run, check_paper_rows):
    table = main_table(run, [0])
    check_paper_rows(table, paper.table("main"))
    measured = table.query("source == 'measured'")
    assert len(measured) == 6 and set(measured["dataset"]) == {"miniature"}
    assert table["n"].dtype == "Int64" and measured["n"].eq(6).all()
    assert measured[list(METRICS)].notna().all(axis=None)


def test_baselines_say_what_they_were_fitted_on_and_keep_their_rows_where_they_cannot_be(run, monkeypatch):
    def fitted():
        return main_table(run, [0]).query("source == 'measured' and supervision == 'Depth'")

    assert set(fitted()["note"]) >= {"fitted on the scored frames of all other drives"}
    (run.prepared / "baseline_truth.npz").touch()
    assert set(fitted()["note"]) >= {"fitted on training-side laser frames"}
    monkeypatch.setattr(main, "score_baselines", lambda run: {})
    assert set(fitted()["method"]) == {"Train set mean", "Per-row mean", "Constant depth"}
    assert fitted()["abs_rel"].isna().all() and fitted()["note"].str.startswith("not run: ").all()


def test_real_frames_an_incomplete_list_and_what_is_not_trained_are_named(run, make_run):
    text = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\ntrain: {lr: }\n"
    rows = main_table(make_run("own", text=text, frames=25, listed=697), [0]).query("source == 'measured'").set_index("method")
    assert set(rows["dataset"]) == {"K"}
    missing = rows.loc["LR-Net + HR-Net, w/ SA"]
    assert np.isnan(missing["abs_rel"]) and missing["note"] == "not run: profile own does not train it"
    assert rows["note"].drop("LR-Net + HR-Net, w/ SA").str.contains("25 of 697 frames").all()
    assert not main_table(run, [0])["note"].str.contains("of 697|of 2 frames").any()


def test_the_difference_to_a_baseline_is_paired(run):
    comparison = compare_with_baselines(run, "lr", [0, 1]).set_index(["baseline", "metric"])
    assert set(comparison.index) == {(b, m) for b in ("Train set mean", "Per-row mean", "Constant depth") for m in ("abs_rel", "a1")}
    row = comparison.loc[("Train set mean", "abs_rel")]
    # the same noise in both cancels, so that the interval has no width
    assert row["difference"] == pytest.approx(0.21 - 0.3)
    assert row["high"] - row["low"] < 1e-12
    assert row["of_variant"] == pytest.approx(0.21) and row["of_baseline"] == pytest.approx(0.3)
    assert row["spread_over_seeds"] == pytest.approx(0.02 / np.sqrt(2))
    assert row["clear_of_zero"]


def test_a_difference_smaller_than_the_images_differ_is_not_clear(run, make_scores, monkeypatch):
    other = make_scores(0.21)
    other["abs_rel"] = other["abs_rel"].to_numpy()[::-1]
    monkeypatch.setattr(main, "score_baselines", lambda run: {"constant": other})
    row = compare_with_baselines(run, "lr", [0, 1]).set_index("metric").loc["abs_rel"]
    assert row["low"] < 0 < row["high"] and not row["clear_of_zero"]
