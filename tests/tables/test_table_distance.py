"""Near and far: made predictions whose faults are known give the numbers that follow."""

import numpy as np
import pandas as pd
import pytest

from dualdepth import paper
from dualdepth.evaluation.distance import PARTS
from dualdepth.tables import distance
from dualdepth.tables.distance import RATIOS, distance_claims, distance_table, far_gain, score_part
from dualdepth.tables.rows import COMPARISON

NEAR, FAR = PARTS
STRETCH = {"lr": 1.3, "dual_no_sa": 1.2, "dual": 1.0}
"""What each network multiplies far depth by."""
FAULT = {"lr": 0.2, "dual_no_sa": 0.2, "dual": 0.1}
"""By how much each is wrong below 8 m; the median is of neither, so the median ratio is that of exact depth."""
SHARE = 5 / 19
"""Share of the near pixels below 8 m: of 30 columns, the protocol's crop takes the first and the last."""


def truths():
    rng = np.random.default_rng(0)
    columns = [rng.uniform(8.5, 19, (3, 30, 15)), rng.uniform(4, 8, (3, 30, 5)), rng.uniform(25, 50, (3, 30, 10))]
    return list(np.concatenate(columns, axis=2))


@pytest.fixture
def run(make_run, monkeypatch):
    maps = truths()

    class Given:
        def __init__(self, run, variant, seed):
            stretch = STRETCH[variant] + 0.1 * seed
            depth = np.stack([t * np.where(t > 20, stretch, np.where(t < 8, 1 + FAULT[variant], 1)) for t in maps])
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
    np.testing.assert_allclose(near["abs_rel"], 0.2 * SHARE)
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
        assert table.loc[(variant, FAR, own), "abs_rel"] == pytest.approx(0, abs=1e-9)
        for scaling in (one, own):
            assert table.loc[(variant, NEAR, scaling), "abs_rel"] == pytest.approx(FAULT[variant] * SHARE)


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
    claims = distance_claims(run, [0, 1])
    assert list(claims.columns) == ["distance", *COMPARISON]
    claims = claims.query("metric == 'abs_rel' and distance != 'far against near'").set_index(["distance", "a", "b"])
    assert set(claims.index) == {(part, a, "lr") for part in PARTS for a in ("dual", "dual_no_sa")}
    far = claims.loc[(FAR, "dual", "lr")]
    assert far["difference"] == pytest.approx(-0.3) and far["spread"] == pytest.approx(0, abs=1e-9)
    assert far["in_words"] == "better by 0.3: the interval over images excludes 0, that over 2 seeds excludes 0"
    assert claims.loc[(FAR, "dual_no_sa", "lr"), "difference"] == pytest.approx(-0.1)
    assert claims.loc[(NEAR, "dual", "lr"), "difference"] == pytest.approx(-0.1 * SHARE)
    assert claims.loc[(NEAR, "dual_no_sa", "lr"), "difference"] == pytest.approx(0, abs=1e-9)


def test_the_gain_of_far_pixels_is_compared_with_that_of_near_ones(run):
    """Far errors are 0.3 and 0.4 before; 0 and 0.1 after with `dual`, 0.2 and 0.3 with `dual_no_sa`."""
    claims = distance_claims(run, [0, 1]).query("distance == 'far against near'")
    assert claims["metric"].eq("abs_rel").all() and claims["n"].eq(3).all() and claims["b"].tolist() == 2 * GAINS_NEAR
    claims = claims.set_index("a")
    expected = {  # far, near
        f"gain of dual, {FAR}": (0.3, 0.1 * SHARE),
        f"relative gain of dual, {FAR}": ((0.3 / 0.3 + 0.3 / 0.4) / 2, 0.5),
        f"gain of dual_no_sa, {FAR}": (0.1, 0),
        f"relative gain of dual_no_sa, {FAR}": ((0.1 / 0.3 + 0.1 / 0.4) / 2, 0),
    }
    assert list(claims.index) == list(expected)
    for name, (far, near) in expected.items():
        assert claims.loc[name, ["mean_a", "mean_b", "difference"]].tolist() == pytest.approx([far, near, far - near], abs=1e-9), name
    assert claims.loc[f"relative gain of dual, {FAR}", "spread"] == pytest.approx(0.25 / 2**0.5)
    words = claims["in_words"].tolist()
    assert words[0].startswith("better by 0.27: ")
    assert words[1] == "better by 0.38: the interval over images excludes 0, that over 2 seeds includes 0"


GAINS_NEAR = [f"gain, {NEAR}", f"relative gain, {NEAR}"]


@pytest.fixture
def given(make_run, monkeypatch):
    """A run whose Abs Rel is given by variant, part and image: image 2 has no far pixels, image 3 none that are near."""
    values = {
        ("lr", NEAR): {0: 0.1, 1: 0.2, 2: 0.3},
        ("dual", NEAR): {0: 0.1, 1: 0.15, 2: 0.1},
        ("lr", FAR): {0: 0.5, 1: 0.4, 3: 0.9},
        ("dual", FAR): {0: 0.2, 1: 0.3, 3: 0.1},
    }

    def near_far(run, variant, seed, own_ratio=False):
        rows = {(image, part): error for part in PARTS for image, error in values[variant, part].items()}
        return pd.DataFrame({"abs_rel": pd.Series(rows), "a1": 1 - pd.Series(rows)}).rename_axis(["image", "part"])

    monkeypatch.setattr(distance, "near_far", near_far)
    text = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\ntrain: {lr: , dual: }\n"
    return make_run("own", text=text), values


def test_gains_are_compared_in_images_that_have_both_parts(given):
    row = far_gain(given[0], "dual", [0], False)
    # far: 0.3, 0.1; near: 0, 0.05
    assert [row["mean_a"], row["mean_b"], row["difference"]] == pytest.approx([0.2, 0.025, 0.175])
    assert [row["low"], row["high"]] == pytest.approx([0.05, 0.3])
    assert row["n"] == 2 and row["in_words"] == "better by 0.17: the interval over images excludes 0, one seed"


def test_relative_gains_are_in_units_of_lr_nets_mean_error_in_the_part(given):
    row = far_gain(given[0], "dual", [0], True)
    # LR-Net's mean errors: 0.6 far, 0.2 near, over all images of the part
    assert [row["mean_a"], row["mean_b"]] == pytest.approx([0.2 / 0.6, 0.025 / 0.2])
    assert row["difference"] == pytest.approx(0.2 / 0.6 - 0.025 / 0.2)


def test_a_gain_that_is_larger_near_by_is_worse(given):
    run, values = given
    values["dual", FAR] = values["lr", FAR]
    assert far_gain(run, "dual", [0], False)["in_words"].startswith("worse by 0.025: ")


def test_gains_of_one_image_are_not_compared(given):
    run, values = given
    for variant in ("lr", "dual"):
        del values[variant, NEAR][1]
    row = far_gain(run, "dual", [0], False)
    assert row["in_words"] == "not compared: 1 image" and row["n"] == 1 and row["a"] == f"gain of dual, {FAR}"


def test_only_what_is_trained_has_gains(given):
    claims = distance_claims(given[0], [0]).query("distance == 'far against near'")
    assert claims["a"].tolist() == [f"gain of dual, {FAR}", f"relative gain of dual, {FAR}"]


def test_a_trainings_parts_are_evaluated_once(run, monkeypatch):
    asked, evaluate = [], distance.evaluate_parts
    monkeypatch.setattr(distance, "evaluate_parts", lambda *a, **k: asked.append(k["own_ratio"]) or evaluate(*a, **k))
    distance_table(run, [0, 1])
    distance_claims(run, [0, 1])
    assert sorted(asked) == 6 * [False] + 6 * [True]  # three networks, two seeds
