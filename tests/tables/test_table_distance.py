"""Near and far: made predictions whose faults are known give the numbers that follow."""

import numpy as np
import pytest

from dualdepth import paper
from dualdepth.evaluation.distance import PARTS
from dualdepth.tables import distance
from dualdepth.tables.distance import RATIOS, distance_claims, distance_table, score_part

NEAR, FAR = PARTS
STRETCH = {"lr": 1.3, "dual_no_sa": 1.2, "dual": 1.0}
"""What each network multiplies far depth by; near depth is exact, and most pixels are near, so the median ratio is that of near ones."""


def truths():
    rng = np.random.default_rng(0)
    near, far = rng.uniform(4, 19, (3, 30, 20)), rng.uniform(25, 50, (3, 30, 10))
    return list(np.concatenate([near, far], axis=2))


@pytest.fixture
def run(make_run, monkeypatch):
    maps = truths()

    class Given:
        def __init__(self, run, variant, seed):
            stretch = STRETCH[variant] + 0.1 * seed
            depth = np.stack([np.where(t > 20, t * stretch, t) for t in maps])
            self.disparities = 0.7 / depth  # of any scale

    monkeypatch.setattr(distance, "Predictions", Given)
    monkeypatch.setattr(distance, "truth", lambda run: maps)
    return make_run()


def test_the_papers_rows_are_all_there_and_unchanged(run, check_paper_rows):
    check_paper_rows(distance_table(run, [0]), paper.table("distance"))


def test_a_training_is_scored_in_one_part(run):
    far, near = score_part(run, "lr", 0, part=FAR), score_part(run, "lr", 0, part=NEAR)
    assert list(far.index) == [0, 1, 2] and far.index.name == "image"
    np.testing.assert_allclose(far["abs_rel"], 0.3)
    np.testing.assert_allclose(near["abs_rel"], 0, atol=1e-12)
    np.testing.assert_allclose(score_part(run, "lr", 0, part=FAR, own_ratio=True)["abs_rel"], 0, atol=1e-12)


def test_faults_of_far_depth_show_in_the_far_rows_with_one_ratio_and_go_with_a_ratio_of_their_own(run):
    table = distance_table(run, [0, 1]).query("source == 'measured'").set_index(["variant", "distance", "scaling"])
    assert len(table) == 12
    one, own = RATIOS[False], RATIOS[True]
    for variant, stretch in STRETCH.items():
        far = table.loc[(variant, FAR, one)]
        assert far["abs_rel"] == pytest.approx(stretch - 1 + 0.05)
        assert far["abs_rel_std"] == pytest.approx(0.1 / 2**0.5)
        assert far["n"] == 3 and far["seeds"] == "0 1"
        for key in ((variant, NEAR, one), (variant, NEAR, own), (variant, FAR, own)):
            assert table.loc[key, "abs_rel"] == pytest.approx(0, abs=1e-9)


def test_rows_bear_the_papers_names(run):
    measured = distance_table(run, [0]).query("source == 'measured'")
    named = dict(zip(measured["variant"], measured["method"]))
    assert named == {"lr": "w/o HR-Net", "dual_no_sa": "w/ HR-Net, w/o SA", "dual": "w/ HR-Net"}
    assert {named["lr"], named["dual"]} == set(paper.table("distance")["method"])
    assert set(measured["distance"]) == set(paper.table("distance")["distance"])


def test_a_network_that_is_not_trained_keeps_its_rows_and_says_why(run, make_run):
    own = make_run("own", text="about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\ntrain: {lr: , dual: }\n")
    rows = distance_table(own, [0]).query("variant == 'dual_no_sa'")
    assert len(rows) == 4 and rows["abs_rel"].isna().all()
    assert rows["note"].eq("not run: profile own does not train it").all()


def test_the_gain_is_judged_in_each_part(run):
    claims = distance_claims(run, [0, 1]).query("metric == 'abs_rel'").set_index(["distance", "a", "b"])
    assert set(claims.index) == {(part, a, "lr") for part in PARTS for a in ("dual", "dual_no_sa")}
    far = claims.loc[(FAR, "dual", "lr")]
    assert far["difference"] == pytest.approx(-0.3) and far["spread"] == pytest.approx(0, abs=1e-9)
    assert far["in_words"].startswith("better by 0.300: outside the interval over images")
    assert claims.loc[(FAR, "dual_no_sa", "lr"), "difference"] == pytest.approx(-0.1)
    assert claims.loc[(NEAR, "dual", "lr"), "difference"] == pytest.approx(0, abs=1e-9)
