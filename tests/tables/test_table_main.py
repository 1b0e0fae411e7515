"""The main table: the paper's rows untouched, ours beside them, and what could not be run said so."""

from types import SimpleNamespace

import numpy as np
import pytest

from dualdepth import paper
from dualdepth.evaluation.depth import METRICS
from dualdepth.tables import main
from dualdepth.tables.main import BASELINES, main_scores, main_table
from dualdepth.tables.scores import Scored

VALUES = {"lr": 0.2, "dual": 0.1, "untrained": 0.6, "constant": 0.5, "row_mean": 0.4, "mean_map": 0.3}


@pytest.fixture
def run(make_run, make_scores, give, monkeypatch):
    """A run of `tiny` whose scores are given."""
    give(lambda variant, seed: make_scores(VALUES[variant] + 0.02 * seed))
    monkeypatch.setattr(main, "untrained_net", lambda run, seed: SimpleNamespace(disparities=lambda paths: seed))
    monkeypatch.setattr(main, "baseline_depths", lambda run, name: ([0], "fitted"))
    monkeypatch.setattr(Scored, "paths", [])
    monkeypatch.setattr(Scored, "truth", [])
    monkeypatch.setattr(
        main, "evaluate", lambda seed, _, *, name, **__: make_scores(VALUES[name] + (0.02 * seed if name == "untrained" else 0))
    )
    return make_run()


def ours(run, seeds):
    table = main_table(run, main_scores(run, seeds))
    return table[table["source"] != "paper"].set_index("method")


def test_a_row_is_the_mean_over_seeds_with_its_spread_and_names_seeds_data_set_and_number_of_images(run, check_paper_rows):
    table = main_table(run, main_scores(run, [0, 3]))
    check_paper_rows(table, paper.table("main"))
    measured = table.query("source == 'measured'").set_index("method")
    assert len(measured) == 6 and set(measured["dataset"]) == {"miniature"}
    assert table["n"].dtype == "Int64" and measured["n"].eq(6).all()
    for method, mean in {"LR-Net, untrained": 0.63, "LR-Net": 0.23, "LR-Net + HR-Net, w/ SA": 0.13}.items():
        row = measured.loc[method]
        assert row["seeds"] == "0 3"
        for metric in METRICS:
            assert row[metric] == pytest.approx(mean), (method, metric)
            assert row[f"{metric}_std"] == pytest.approx(0.06 / np.sqrt(2)), (method, metric)
    for name, method in BASELINES.items():  # which know no seed
        assert measured.loc[method, "abs_rel"] == pytest.approx(VALUES[name])
        assert measured.loc[method, "seeds"] == "" and measured.loc[method, "supervision"] == "Depth"


def test_baselines_say_what_they_were_fitted_on_and_keep_their_rows_where_they_cannot_be(run, monkeypatch):
    assert ours(run, [0]).loc["Train set mean", "note"] == "fitted"
    monkeypatch.setattr(main, "baseline_depths", lambda run, name: (None, "why not"))
    rows = ours(run, [0]).loc[list(BASELINES.values())]
    assert rows["abs_rel"].isna().all() and rows["source"].eq("not run").all() and rows["reason"].eq("why not").all()


def test_real_frames_an_incomplete_list_and_what_is_not_trained_are_named(run, make_run):
    rows = ours(make_run("own", kitti="train: {lr: }\n", frames=25, listed=697), [0])
    assert set(rows["dataset"]) == {"K"}
    missing = rows.loc["LR-Net + HR-Net, w/ SA"]
    assert np.isnan(missing["abs_rel"]) and missing["reason"] == "profile own does not train dual"
    assert rows["note"].drop("LR-Net + HR-Net, w/ SA").str.contains("25 of 697 frames").all()
    assert not ours(run, [0])["note"].str.contains("of 697|of 2 frames").any()
