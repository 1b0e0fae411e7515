"""An own camera has no ground truth: every table keeps the paper's rows, has no number of ours that would need one, and says so."""

import numpy as np
import pytest

from dualdepth.evaluation.depth import METRICS
from dualdepth.tables import main, scoring
from dualdepth.tables.ablation import ablation_claims, ablation_table
from dualdepth.tables.distance import distance_claims, distance_table
from dualdepth.tables.rows import NO_TRUTH, compare_trainings, training_row
from dualdepth.tables.sharpness import detail_claims, sharpness_table

OWN = "about: a test\ndata: {source: own}\n"


@pytest.fixture
def run(make_run):
    return make_run("own", text=OWN)


@pytest.mark.parametrize("table", [main.main_table, ablation_table, distance_table, sharpness_table], ids=lambda made: made.__name__)
def test_every_row_of_ours_is_without_numbers_and_says_why(run, table, monkeypatch):
    monkeypatch.setattr(scoring, "truth", None)  # nothing is scored
    made = table(run, [0])
    ours = made[made["source"] == "measured"]
    assert len(ours) and (ours["note"] == NO_TRUTH).all()
    assert {"n", "seeds"} <= set(made), "readers of the files count on them"
    assert ours[[c for c in (*METRICS, "n", "tenengrad", "ratio") if c in ours]].isna().all(axis=None)
    assert made.loc[made["source"] == "paper"].notna().any(axis=None)


@pytest.mark.parametrize("claims", [ablation_claims, distance_claims, detail_claims], ids=lambda made: made.__name__)
def test_no_claim_is_compared(run, claims):
    table = claims(run, [0])
    assert len(table) and (table["metric"] == "").all() and table["in_words"].str.startswith("not run").all()


def test_a_benchmark_with_a_truth_of_its_own_is_scored_all_the_same(run, make_scores):
    row = training_row(run, "lr", [0], scores=lambda *_: make_scores(0.3), own_truth=True)
    assert row["abs_rel"] == pytest.approx(0.3) and row["n"] == 6
    compared = compare_trainings(run, [("dual", "lr")], [0], scores=lambda _, v, __: make_scores(0.3 + (v == "lr")), own_truth=True)
    assert compared["difference"].iloc[0] == pytest.approx(-1)


def test_there_are_no_baselines_and_the_empty_comparison_keeps_its_columns(run, monkeypatch):
    assert scoring.score_baselines(run) == {}
    monkeypatch.setattr(main, "score_training", lambda *_: scoring.unscored(np.ones((2, 4, 5))))
    empty = main.compare_with_baselines(run, "lr", [0])
    assert not len(empty) and {"baseline", "difference", "clear_of_zero"} <= set(empty)
