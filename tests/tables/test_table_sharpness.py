"""Sharpness: every reading of Tenengrad from known maps, and an exact network against a blurred one."""

import cv2
import numpy as np
import pandas as pd
import pytest

from dualdepth import paper
from dualdepth.evaluation.depth import resized
from dualdepth.evaluation.objects import POLE
from dualdepth.evaluation.sharpness import boundary_scores, tenengrad
from dualdepth.scoring import Predictions
from dualdepth.tables import sharpness
from dualdepth.tables.sharpness import THRESHOLDS, detail_claims, detail_table, sharpness_table

TEXT = """
about: x
world: {size: [200, 200]}
data: {source: miniature, hr_size: [192, 192]}
training: {precision: float32, encoder: resnet18, pretrained: false}
"""
KITTI = "about: x\ndata:\n  source: kitti\n  train_list: eigen_zhou\n"
PAPER_RATIO = 106987.2 / 20784.4


def scene(image):
    """Exact depth (192, 192) of a street: sky (0), road, a car, a pole, a sign that hangs; and the labels."""
    depth, labels = np.zeros((192, 192)), np.zeros((192, 192), np.uint8)
    depth[80:] = (150 / np.arange(1, 113)).clip(max=70)[:, None]
    depth[90:150, 30 + 10 * image : 90] = 9
    depth[30:45, 150:175] = 20
    depth[40:160, 130:136], labels[40:160, 130:136] = 12, POLE
    return depth, labels


SCENES = [scene(image) for image in range(2)]


@pytest.fixture
def run(make_run, monkeypatch):
    """LR-Net's maps are the exact ones seen at a third of the size, the dual networks' are exact; a later seed is a little off."""
    exact = [np.where(depth > 0, depth, 80) for depth, _ in SCENES]
    small = np.stack([1 / cv2.resize(depth, (64, 64), interpolation=cv2.INTER_AREA) for depth in exact])
    maps = {"lr": small, "dual": 1 / np.stack(exact), "dual_no_sa": 1 / np.stack(exact)}

    class Given(Predictions):
        def __init__(self, run, variant, seed):
            self.scores = pd.DataFrame({"scale_ratio": 0.5}, index=pd.RangeIndex(2, name="image"))
            self.disparities = maps[variant] / (2 + seed)
            self._settings, self._truth = run.profile.evaluation, exact

    monkeypatch.setattr(sharpness, "Predictions", Given)
    monkeypatch.setattr(sharpness, "dense_truth", lambda run, image: SCENES[image][0])
    monkeypatch.setattr(sharpness, "label_map", lambda run, image: SCENES[image][1])
    return make_run("own", text=TEXT)


def test_the_papers_rows_are_unchanged_and_have_their_ratio(run, check_paper_rows):
    table = sharpness_table(run, [0])
    check_paper_rows(table, paper.table("sharpness"))
    ratios = table.loc[table["source"] == "paper"].set_index("method")["ratio"]
    assert np.isnan(ratios["w/o HR-Net"]) and ratios["w/ HR-Net"] == pytest.approx(PAPER_RATIO)


def test_every_reading_has_a_row_for_each_network(run):
    measured = sharpness_table(run, [0]).query("source == 'measured'")
    expected = {(m, s, t, n) for m, ts in THRESHOLDS.items() for s in ("native", "common") for t in ts for n in ("w/o HR-Net", "w/ HR-Net")}
    assert set(zip(measured["map"], measured["size"], measured["threshold"], measured["method"])) == expected
    assert len(measured) == len(expected) and measured["n"].eq(2).all() and measured["seeds"].eq("0").all()


def test_a_row_is_tenengrad_of_the_scaled_or_normalised_map_at_its_size_over_images_and_seeds(run):
    table = sharpness_table(run, [0, 1]).query("source == 'measured'").set_index(["map", "size", "threshold", "method"])["tenengrad"]
    small = [cv2.resize(np.where(d > 0, d, 80), (64, 64), interpolation=cv2.INTER_AREA) for d, _ in SCENES]
    # at the second seed depth is half as far again, and clamped at 80 m
    sizes = {"native": small, "common": [resized(d, (192, 192)) for d in small]}
    for size, maps in sizes.items():
        depths = [np.minimum(depth * factor, 80) for depth in maps for factor in (1, 1.5)]
        for t, expected in zip(THRESHOLDS["depth, m"], np.mean([tenengrad(d, THRESHOLDS["depth, m"]) for d in depths], axis=0)):
            assert table["depth, m", size, t, "w/o HR-Net"] == pytest.approx(expected, rel=1e-5)
    inverses = [resized(1 / d, (192, 192)) for d in small]
    kind = "inverse depth / its mean"
    expected = np.mean([tenengrad(i / i.mean(), [0.5]) for i in inverses])
    assert table[kind, "common", 0.5, "w/o HR-Net"] == pytest.approx(expected, rel=1e-5)  # the seeds' scale is gone


def test_the_ratio_is_dual_over_lr_and_three_times_larger_at_native_size(run):
    measured = sharpness_table(run, [0]).query("source == 'measured'")
    with_hr, without = measured.query("method == 'w/ HR-Net'"), measured.query("method == 'w/o HR-Net'")
    known = without["tenengrad"].to_numpy() > 0
    np.testing.assert_allclose(with_hr["ratio"][known], (with_hr["tenengrad"].to_numpy() / without["tenengrad"].to_numpy())[known])
    assert without["ratio"].isna().all()
    ratio = with_hr.set_index(["map", "size", "threshold"])["ratio"]
    assert 2.5 < ratio["inverse depth / its mean", "native", 0] < 4
    assert 0.9 < ratio["inverse depth / its mean", "common", 0] < 1.3


def planted(monkeypatch, values):
    """Makes every Tenengrad 50 without and 60 with HR-Net, except for the (map, size, threshold) of `values`."""

    def maps(run, variant, seed):
        for kind in THRESHOLDS:
            for size in ("native", "common"):
                yield kind, size, (kind, size, variant)

    def given(key, thresholds):
        kind, size, variant = key
        return np.array([values.get((kind, size, t), (50.0, 60.0))[variant == "dual"] for t in thresholds])

    monkeypatch.setattr(sharpness, "_maps", maps)
    monkeypatch.setattr(sharpness, "tenengrad", given)


def marks(table):
    """What is marked, by (map, size, threshold, method)."""
    marked = table[table["closest"] != ""]
    return dict(zip(zip(*(marked[c] for c in ("map", "size", "threshold", "method"))), marked["closest"]))


def test_the_reading_nearest_by_ratio_and_the_one_nearest_by_numbers_are_marked(run, monkeypatch):
    by_ratio, by_numbers = ("depth, m", "common", 5), ("inverse depth / its mean", "native", 0.25)
    both_numbers_near = (20784.4 * 1.1, 106987.2 * 0.9)
    one_number_exact = {("depth, m", "native", 0): (20784.4, 900.0), ("depth, m", "native", 2): (900.0, 106987.2)}
    planted(monkeypatch, {by_ratio: (10.0, 10.0 * PAPER_RATIO), by_numbers: both_numbers_near, **one_number_exact})
    expected = {(*by_ratio, m): "ratio" for m in ("w/o HR-Net", "w/ HR-Net")}
    expected |= {(*by_numbers, m): "numbers" for m in ("w/o HR-Net", "w/ HR-Net")}
    assert marks(sharpness_table(run, [0])) == expected


def test_a_reading_that_is_nearest_in_both_ways_has_both_marks(run, monkeypatch):
    place = ("inverse depth / its mean", "common", 2)
    planted(monkeypatch, {place: (20784.4, 106987.2)})
    assert marks(sharpness_table(run, [0])) == {(*place, m): "ratio, numbers" for m in ("w/o HR-Net", "w/ HR-Net")}


def test_a_threshold_that_nothing_passes_has_no_ratio_and_is_never_nearest(run, monkeypatch):
    nothing = {(m, s, t): (0.0, 7.0) for m, ts in THRESHOLDS.items() for s in ("native", "common") for t in ts}
    place = ("depth, m", "native", 10)
    planted(monkeypatch, nothing | {place: (2.0, 3.0)})
    table = sharpness_table(run, [0])
    assert table.query("source == 'measured'")["ratio"].notna().sum() == 1
    assert set(marks(table).values()) == {"ratio, numbers"} and {key[:3] for key in marks(table)} == {place}


def test_two_networks_are_needed(make_run, check_paper_rows):
    table = sharpness_table(make_run("own", text=KITTI + "train: {lr: }\n"), [0])
    check_paper_rows(table, paper.table("sharpness"))
    measured = table.query("source == 'measured'")
    assert measured["method"].tolist() == ["w/o HR-Net", "w/ HR-Net"] and measured["tenengrad"].isna().all()
    assert measured["note"].eq("not run: profile own does not train dual").all()


def test_exact_maps_beat_blurred_ones_at_boundaries_and_on_poles(run):
    table = detail_table(run, [0]).set_index("variant")
    exact, blurred = table.loc["dual"], table.loc["lr"]
    for column in ("boundary_f1", "boundary_lateral_precision", "boundary_lateral_recall", "boundary_lateral_f1", "pole_a1"):
        assert exact[column] == pytest.approx(1), column
        assert blurred[column] < 0.9, column
    assert exact["pole_abs_rel"] == pytest.approx(0, abs=1e-6) and blurred["pole_abs_rel"] > 0.1
    assert exact["pole_n"] == 2 and exact["n"] == 2
    assert table["method"].tolist() == ["LR-Net", "LR-Net + HR-Net, w/o SA", "LR-Net + HR-Net, w/ SA"]


def test_boundaries_are_scored_with_the_sky_at_the_farthest_depth(run):
    depth, _ = SCENES[0]
    small = cv2.resize(np.where(depth > 0, depth, 80), (64, 64), interpolation=cv2.INTER_AREA)
    expected = boundary_scores(resized(small, (192, 192)), np.where(depth > 0, depth, 80))
    row = sharpness.score_boundaries(run, "lr", 0).loc[0]
    assert row.to_dict() == pytest.approx(expected, rel=1e-6)
    assert 0 < row["lateral_f1"] < 1


def test_details_are_means_with_a_spread_over_seeds(run):
    table = detail_table(run, [0, 1]).set_index("variant")
    # the second seed's depth is half as far again: wrong on poles, at boundaries only where it meets the clamp
    assert table.loc["dual", "pole_abs_rel"] == pytest.approx(0.25, rel=1e-5)
    assert table.loc["dual", "pole_abs_rel_std"] == pytest.approx(0.5 / 2**0.5, rel=1e-5)
    assert table.loc["dual", "boundary_f1_std"] > 0 and table.loc["dual", "seeds"] == "0 1"


def test_images_without_a_pole_do_not_count_on_poles(run, monkeypatch):
    monkeypatch.setattr(sharpness, "label_map", lambda run, image: SCENES[image][1] * (image == 1))
    assert list(sharpness.score_poles(run, "lr", 0).index) == [1]
    table = detail_table(run, [0]).set_index("variant")
    assert table.loc["lr", "pole_n"] == 1 and table.loc["lr", "n"] == 2


def test_real_frames_have_no_exact_depth_and_the_table_says_so(run, make_run):
    own = make_run("kitti", text=KITTI)
    table = detail_table(own, [0])
    assert table["method"].tolist() == ["LR-Net", "LR-Net + HR-Net, w/o SA", "LR-Net + HR-Net, w/ SA"]
    assert table["note"].eq("not run: needs exact dense depth, which the laser does not give").all()
    assert set(table["source"]) == {"measured"} and not table.select_dtypes("number").notna().any(axis=None)
    assert detail_claims(own, [0]).empty


def test_details_are_compared_in_pairs(run):
    claims = detail_claims(run, [0]).set_index(["of", "a", "b", "metric"])
    boundaries = claims.loc[("boundaries", "dual", "lr", "lateral_f1")]
    poles = claims.loc[("poles", "dual", "lr", "abs_rel")]
    assert boundaries["difference"] > 0.1 and boundaries["in_words"].startswith("better by")
    assert poles["difference"] < -0.1 and poles["in_words"].startswith("better by")
    assert claims.loc[("boundaries", "dual", "dual_no_sa", "f1"), "in_words"].startswith("the same")
    assert len(claims) == 2 * 3 * 2
