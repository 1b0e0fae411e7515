"""An own camera has no ground truth: every table keeps the paper's rows, has no number of ours that would need one, and says so."""

import pytest

from dualdepth.evaluation.depth import METRICS
from dualdepth.tables import ablation, distance, main, sharpness
from dualdepth.tables.scores import NO_TRUTH, Trained, collect

SEEDS = [0]
TABLES = {
    "main": lambda run: main.main_table(run, main.main_scores(run, SEEDS)),
    "ablation": lambda run: ablation.ablation_table(run, collect(run, ablation.VARIANTS, SEEDS)),
    "distance": lambda run: distance.distance_table(run, {False: collect(run, distance.METHODS, SEEDS)}),
    "sharpness": lambda run: sharpness.sharpness_table(sharpness.tenengrad_scores(run, SEEDS)),
}


@pytest.fixture
def run(make_run, monkeypatch):
    monkeypatch.setattr(Trained, "scores", None)  # nothing is scored
    return make_run("own", text="about: a test\ndata: {source: own}\n")


@pytest.mark.parametrize("table", TABLES)
def test_every_row_of_ours_is_without_numbers_and_says_why(run, table):
    made = TABLES[table](run)
    ours = made[made["source"] != "paper"]
    assert len(ours) and (ours["source"] == "not run").all() and (ours["reason"] == NO_TRUTH).all()
    assert ours[[c for c in (*METRICS, "n", "tenengrad", "ratio") if c in ours]].isna().all(axis=None)
    assert made.loc[made["source"] == "paper"].notna().any(axis=None)
