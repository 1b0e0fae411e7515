"""Make3D's table: made predictions whose faults are known give the numbers that follow, and are kept while they fit."""

from functools import partial
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from dualdepth import paper
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.errors import InputError
from dualdepth.evaluation.make3d import CONVENTIONS, METRICS, ROWS
from dualdepth.run import Sources
from dualdepth.tables import make3d, scores
from dualdepth.tables.make3d import NO_PHOTOS, VARIANTS, load_photos, make3d_examples, make3d_scores, make3d_table, score_photos
from dualdepth.tables.rows import paired
from dualdepth.tables.scores import Trained, trained

FAULT = {"lr": 0.4, "dual_no_sa": 0.3, "dual": 0.2}
"""By how much each network is too far in the right fifth of the photo; elsewhere it is exact."""
PHOTOS = 3


def grid(number):
    """Near depth, and far depth in the right fifth, so that the median is that of exact depth."""
    rng = np.random.default_rng(number)
    return np.concatenate([rng.uniform(2, 20, (55, 244)), rng.uniform(30, 39, (55, 61))], axis=1)


def write_grid(root, number, depth):
    """Laser depth (55, 305) in metres as Make3D's file."""
    points = np.zeros((55, 305, 4))
    points[..., 3] = depth
    savemat(root / "Gridlaserdata" / f"depth_sph_corr-{number}.mat", {"Position3DGrid": points})


def write_photos(root):
    """Photos whose brightness is their number, with their grids."""
    for folder in ("Test134", "Gridlaserdata"):
        (root / folder).mkdir(parents=True)
    for number in range(PHOTOS):
        photo = np.full((160, 120, 3), 40 * number, np.uint8)
        (root / "Test134" / f"img-{number}.jpg").write_bytes(cv2.imencode(".jpg", photo)[1].tobytes())
        write_grid(root, number, grid(number))


@pytest.fixture
def run(make_run, cards, tmp_path, monkeypatch):
    """A run with photos and weights, whose networks know the grids; `run.predicted` lists what was predicted."""
    run = make_run()
    write_photos(tmp_path / "photos")
    Sources(tmp_path, tmp_path, make3d_root=tmp_path / "photos").save(run)
    cards |= {variant: {"drives": ["x"]} for variant in VARIANTS}
    for variant in VARIANTS:
        for seed in (0, 1):
            run.training(variant, seed).mkdir(parents=True)
            run.weights(variant, seed).write_bytes(b"%s %d" % (variant.encode(), seed))
    run.predicted = []

    def predict(net, paths, *, read):
        shown = [read(path) for path in paths]
        assert [round(photo.mean() / 40) for photo in shown] == [int(path.stem[4:]) for path in paths]
        whole = shown[0].shape[:2] == (160, 120)
        assert whole or shown[0].shape[:2] == (60, 120)
        run.predicted.append((net, "whole" if whole else "band", len(paths)))
        variant, seed = net.split()
        wrong = np.where(np.arange(305) >= 244, 1 + FAULT.get(variant, 1.0) + 0.1 * int(seed), 1)
        truths = [grid(int(path.stem[4:])) for path in paths]
        return np.stack([0.7 / ((truth if whole else truth[ROWS]) * wrong) for truth in truths])  # of any scale

    monkeypatch.setattr(scores, "code_digest", lambda *steps: "this")  # parses the package at every call
    monkeypatch.setattr(scores, "load", lambda path, *_: SimpleNamespace(disparities=partial(predict, path.read_text())))
    monkeypatch.setattr(make3d, "untrained_net", lambda _, seed: SimpleNamespace(disparities=partial(predict, f"untrained {seed}")))
    return run


def table_of(run, seeds):
    return make3d_table(run, make3d_scores(run, seeds))


def score(run, variant="lr", convention="band"):
    """Asked of a new object, as by another notebook."""
    return score_photos(Trained(run, variant, 0), load_photos(run), convention)


def test_each_network_has_a_row_for_each_convention_below_the_papers(run, check_paper_rows):
    table = table_of(run, [0, 1])
    check_paper_rows(table, paper.table("make3d"))
    table = table.query("source == 'measured'")
    assert "Train set mean" not in set(table["method"])  # without training-side laser frames
    rows = table.dropna(subset="variant").set_index(["variant", "convention"])
    assert set(rows.index) == {(variant, convention) for variant in VARIANTS for convention in CONVENTIONS}
    for (variant, _), row in rows.iterrows():
        assert row["abs_rel"] == pytest.approx((FAULT[variant] + 0.05) / 5)
        assert row["abs_rel_std"] == pytest.approx(0.1 / 5 / 2**0.5)
        assert row["n"] == PHOTOS and row["seeds"] == "0 1" and row["supervision"] == "-"
        assert row["note"].startswith("resnet18, ") and row["note"].endswith("not fine-tuned")
        assert row[list(METRICS)].notna().all()
    np.testing.assert_allclose(rows.loc[("lr", "band"), METRICS], rows.loc[("lr", "whole"), METRICS])
    untrained = table[table["method"] == "LR-Net, untrained"]
    assert untrained["convention"].tolist() == list(CONVENTIONS) and untrained["abs_rel"].min() > rows["abs_rel"].max()


def test_constants_are_scored_as_the_networks_are_and_the_mean_as_it_is(run):
    save_ground_truth(run.prepared / "baseline_truth.npz", [np.full((8, 9), 12.5)])
    table = table_of(run, [0]).set_index("method")
    grids = [grid(number)[ROWS] for number in range(PHOTOS)]
    expected = [np.abs(1 - np.median(g) / g).mean() for g in grids]
    assert table.loc["Constant depth", "abs_rel"] == pytest.approx(np.mean(expected))
    mean = table[table["source"] == "measured"].loc["Train set mean"]
    assert mean["abs_rel"] == pytest.approx(np.mean([np.abs(1 - 12.5 / g).mean() for g in grids]))
    assert mean["supervision"] == "Depth" and mean["note"].startswith("12.5 m, mean of training-side laser frames")
    assert mean["n"] == PHOTOS and mean["convention"] == "either"


def test_a_truncated_photo_is_told_in_the_notes_and_two_are_one_too_many(run, tmp_path):
    def truncate(name):
        path = tmp_path / "photos" / "Test134" / name
        path.write_bytes(path.read_bytes()[:-2])

    truncate("img-1.jpg")
    notes = table_of(run, [0]).dropna(subset="variant")["note"]
    assert notes.str.endswith("not fine-tuned; img-1.jpg is truncated").all()
    truncate("img-0.jpg")
    with pytest.raises(InputError, match=r"Test134: img-0\.jpg, img-1\.jpg are truncated; one photo is published so"):
        table_of(run, [0])


def test_fewer_photos_than_are_published_are_told_of_real_data(run):
    assert not table_of(run, [0])["note"].str.contains("of 134").any()
    run.profile = run.profile.model_copy(update={"world": None})
    assert table_of(run, [0]).dropna(subset="variant")["note"].str.endswith(f"{PHOTOS} of 134 photos").all()


def test_without_make3d_root_the_rows_say_how_to_get_it(run, tmp_path):
    Sources(tmp_path, tmp_path).save(run)
    ours = table_of(run, [0]).query("source == 'not run'")
    assert len(ours) == 1 + 2 * 4 and ours["reason"].eq(NO_PHOTOS).all()
    assert ours[["abs_rel", "sq_rel", "rmse"]].isna().all(axis=None)
    assert paired(make3d_scores(run, [0]), "dual", "lr", part="band")[0]["reason"] == NO_PHOTOS
    assert load_photos(run) is None and make3d_examples(trained(run, "lr", 0)) is None


def test_scores_of_each_convention_are_kept_until_a_photo_or_a_grid_changes(run, tmp_path):
    first = score(run)
    np.testing.assert_allclose(score(run), first, rtol=1e-12)
    score(run, convention="whole")
    assert run.predicted == [("lr 0", "band", PHOTOS), ("lr 0", "whole", PHOTOS)]
    path = tmp_path / "photos" / "Test134" / "img-0.jpg"
    path.write_bytes(path.read_bytes() + b"\0")
    np.testing.assert_allclose(score(run), first, rtol=1e-12)
    write_grid(tmp_path / "photos", 0, grid(77))
    assert (score(run)["abs_rel"] != first["abs_rel"]).any() and len(run.predicted) == 4


def test_examples_show_the_band_with_depth_in_metres_where_it_is_scored(run, tmp_path):
    examples = make3d_examples(trained(run, "dual", 0), count=2, size=(21, 305))
    assert examples[3] == ["img-0.jpg", "img-2.jpg"]
    for number, image, truth, prediction in zip((0, 2), *examples[:3]):
        assert image.shape == (21, 305, 3) and round(image.mean() / 40) == number
        np.testing.assert_array_equal(truth, grid(number)[ROWS])
        np.testing.assert_allclose(prediction, truth * np.where(np.arange(305) >= 244, 1.2, 1))
    enlarged = make3d_examples(trained(run, "dual", 0), count=2, size=(42, 610))
    assert {values.shape[:2] for part in enlarged[:3] for values in part} == {(42, 610)}
    np.testing.assert_array_equal(enlarged[1][1][1::2, 1::2], grid(2)[ROWS])
    write_grid(tmp_path / "photos", 0, np.where(np.arange(305) < 100, 70, 5))  # cells at 70 m are not scored
    truth = make3d_examples(trained(run, "dual", 0), count=1, size=(21, 305))[1][0]
    assert (truth[:, :100] == 0).all() and (truth[:, 100:] == 5).all()
