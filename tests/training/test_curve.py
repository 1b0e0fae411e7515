"""The curve of error against time scores a checkpoint as the tables would score the weights that are made of it."""

import types

import numpy as np
import pandas as pd
import pytest

from dualdepth.evaluation.depth import evaluate
from dualdepth.model import load
from dualdepth.training import variants
from tools import curve

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("average", [0.0, 0.9])
def test_the_last_checkpoint_has_the_scores_of_the_weights(after_stage_1, monkeypatch, average):
    monkeypatch.setattr(variants, "checkpoint_paths", lambda folder: [])  # else a training that has ended deletes them
    run = after_stage_1(train={"lr": None, "dual": {"training.beyond_paper_average": average}})
    weights = variants.train_variant(run, "dual", 0)
    frames = [triplet.paths[0] for triplet in variants.training_data(run, "dual")[0]]
    truth = [np.linspace(1, 70, 375 * 1242).reshape(375, 1242)] * len(frames)
    monkeypatch.setattr(curve, "Scored", lambda _: types.SimpleNamespace(paths=frames, truth=truth))
    found = curve.score(run, "dual", max(weights.parent.glob("checkpoint_*.pt")))
    expected = evaluate(load(weights, "cpu", "float32").disparities(frames), truth, kind="disparity")
    assert found["abs_rel"] == pytest.approx(expected["abs_rel"].mean(), rel=1e-6) and found["minutes"] >= 0
    assert curve.drawn(pd.DataFrame([found])).axes[0].lines
