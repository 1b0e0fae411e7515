"""The curve of error against time scores a checkpoint as the tables score the weights that are made of it."""

import sys
import types

import numpy as np
import pandas as pd
import pytest

from dualdepth.training import variants
from tools import curve

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("average", [0.0, 0.9])
def test_the_last_checkpoint_has_the_scores_and_the_time_of_the_weights(after_stage_1, monkeypatch, average):
    monkeypatch.setattr(variants, "checkpoint_paths", lambda folder: [])  # else a training that has ended deletes them
    run = after_stage_1(train={"lr": None, "dual": {"training.beyond_paper_average": average}})
    weights = variants.train_variant(run, "dual", 0)
    frames = [triplet.paths[0] for triplet in variants.training_data(run, "dual")[0]]
    truth = [np.linspace(1, 70, 375 * 1242).reshape(375, 1242)] * len(frames)
    monkeypatch.setattr(curve, "Scored", lambda _: types.SimpleNamespace(paths=frames, truth=truth))
    monkeypatch.setattr(curve, "Run", lambda _: run)
    monkeypatch.setattr(curve.time, "sleep", lambda _: None)
    monkeypatch.setattr(sys, "argv", ["curve", "lr", "dual"])
    curve.main()
    table = pd.read_csv(run.results / "tables" / "error_by_time.csv")
    assert [*table["variant"]] == ["lr", "dual", "dual", "dual"] and (run.results / "figures" / "error_by_time.png").exists()
    before, last, kept = (table.iloc[row].drop(["variant", "minutes"]).astype(float) for row in (1, 2, 3))
    assert last["step"] == kept["step"] == before["step"] + 1 and last["abs_rel"] != before["abs_rel"]
    assert np.allclose(last, kept, rtol=1e-6)
    seconds = variants.load_card(weights)["seconds_of_last_run"]
    assert curve.score(run, "dual", weights)["minutes"] == pytest.approx(seconds / 60, abs=0.06)
