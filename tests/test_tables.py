"""The main table: the paper's rows untouched, ours beside them, and what could not be run said so."""

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper, tables
from dualdepth.evaluation.depth import METRICS
from dualdepth.results import Run


def scores(value, images=6):
    rng = np.random.default_rng(0)
    frame = pd.DataFrame({m: value + rng.normal(0, 0.01, images) for m in METRICS})
    return frame.assign(scale_ratio=1.0, valid_pixels=10).rename_axis("image")


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run of `tiny` whose scores are given."""
    (tmp_path / "notebooks").mkdir()
    (tmp_path / "Snakefile").touch()
    monkeypatch.setattr(tables, "score_baselines", lambda run: {"constant": scores(0.5), "row_mean": scores(0.4), "mean_map": scores(0.3)})
    monkeypatch.setattr(tables, "score_untrained", lambda run, seed: scores(0.6))
    monkeypatch.setattr(tables, "score_training", lambda run, variant, seed: scores(0.2 + 0.02 * seed))
    monkeypatch.setattr(tables, "scored_note", lambda run: "")
    return Run("tiny", tmp_path)


def test_the_papers_rows_are_all_there_and_unchanged(run):
    table = tables.main_table(run, [0])
    published = table[table["source"] == "paper"].reset_index(drop=True)
    expected = paper.table("main")
    pd.testing.assert_frame_equal(published[expected.columns], expected, check_dtype=False)
    assert published["n"].isna().all()


def test_every_seed_has_its_row_and_the_data_set_is_named(run):
    measured = tables.main_table(run, [0, 3]).query("source == 'measured'")
    trained = measured[measured["method"] == "LR-Net"]
    assert trained["seed"].tolist() == [0, 3]
    assert set(measured["dataset"]) == {"miniature"}
    assert measured["n"].eq(6).all()
    assert measured[list(METRICS)].notna().all(axis=None)


def test_baselines_that_cannot_be_fitted_keep_their_rows_and_say_why(run, monkeypatch):
    monkeypatch.setattr(tables, "score_baselines", lambda run: {})
    table = tables.main_table(run, [0]).query("source == 'measured' and supervision == 'Depth'")
    assert set(table["method"]) == {"Train set mean", "Per-row mean", "Constant depth"}
    assert table["abs_rel"].isna().all()
    assert table["note"].str.startswith("not run: ").all()


def test_an_incomplete_list_is_said_in_every_measured_row(run, monkeypatch):
    monkeypatch.setattr(tables, "scored_note", lambda run: "25 of 697 frames")
    assert tables.main_table(run, [0]).query("source == 'measured'")["note"].str.contains("25 of 697 frames").all()


def test_the_difference_to_a_baseline_is_paired(run):
    comparison = tables.compare_with_baselines(run, "lr", [0, 1]).set_index(["baseline", "metric"])
    row = comparison.loc[("Train set mean", "abs_rel")]
    # the same noise in both cancels, so that the interval has no width
    assert row["difference"] == pytest.approx(0.21 - 0.3)
    assert row["high"] - row["low"] < 1e-12
    assert row["spread_over_seeds"] == pytest.approx(0.02 / np.sqrt(2))
    assert row["clear_of_zero"]
