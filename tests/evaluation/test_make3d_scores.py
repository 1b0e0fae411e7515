"""Make3D's criterion C1: closed forms, a slow reference, and a scene that tells a wrong band or resize."""

import math

import numpy as np
import pytest

from dualdepth.errors import InputError
from dualdepth.evaluation.make3d import CONVENTIONS, METRICS, evaluate_make3d, on_grid, visible

GRID = (55, 305)


def sample(seed, size):
    """A positive prediction, and a grid with cells on both sides of 0 and of 70 m."""
    rng = np.random.default_rng(seed)
    grid = rng.uniform(0.5, 85, GRID)
    grid[rng.random(GRID) < 0.1] = 0
    grid[rng.random(GRID) < 0.05] = 70
    return rng.uniform(0.1, 9, size).astype(np.float32), grid


def slow(prediction, grid, convention):
    """The protocol, cell by cell."""
    height, width = prediction.shape
    gts, preds = [], []
    for row in range(21):
        for column in range(305):
            source = (row + 17) * height // 55 if convention == "whole" else row * height // 21
            gt = grid[row + 17, column]
            if 0 < gt < 70:
                gts.append(float(gt))
                preds.append(float(prediction[source, column * width // 305]))
    ratio = np.median(gts) / np.median(preds)
    preds = [min(p * ratio, 70.0) for p in preds]
    n, pairs = len(gts), list(zip(gts, preds))
    return {
        "abs_rel": sum(abs(g - p) / g for g, p in pairs) / n,
        "sq_rel": sum((g - p) ** 2 / g for g, p in pairs) / n,
        "rmse": math.sqrt(sum((g - p) ** 2 for g, p in pairs) / n),
        "log10_rms": math.sqrt(sum((math.log10(g) - math.log10(p)) ** 2 for g, p in pairs) / n),
        "log10": sum(abs(math.log10(g) - math.log10(p)) for g, p in pairs) / n,
        "scale_ratio": ratio,
        "valid_pixels": n,
    }


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(192, 640), (384, 1248), (128, 416), (64, 192), (21, 305), (7, 11)])
def test_scores_equal_a_slow_reference(convention, size):
    prediction, grid = sample(size[0], size)
    row = evaluate_make3d([prediction], [grid], convention).loc[0]
    assert row.to_dict() == pytest.approx(slow(prediction, grid, convention))


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("factor", [1, 0.02, 300])
def test_true_depth_of_any_scale_scores_zeros(convention, factor):
    grid = np.random.default_rng(0).uniform(1, 69, GRID)
    prediction = factor * (grid if convention == "whole" else grid[17:38])
    frame = evaluate_make3d([prediction], [grid], convention)
    np.testing.assert_allclose(frame[list(METRICS)], 0, atol=1e-9)
    assert frame.loc[0, "scale_ratio"] == pytest.approx(1 / factor) and frame.loc[0, "valid_pixels"] == 21 * 305


def test_a_constant_scores_the_spread_about_the_median():
    grid = np.full(GRID, 10.0)
    grid[:, :100] = 40
    row = evaluate_make3d([np.full((4, 6), 0.3)], [grid], "band").loc[0]
    share = 100 / 305  # a prediction of 10 m against 40 m
    expected = [share * 30 / 40, share * 900 / 40, math.sqrt(share) * 30, math.sqrt(share) * math.log10(4), share * math.log10(4)]
    assert row[list(METRICS)].tolist() == pytest.approx(expected)


def test_the_two_log10_of_one_wrong_cell():
    grid = np.full(GRID, 1.0)
    prediction = np.ones((21, 305))
    prediction[3, 200] = 10.0
    row = evaluate_make3d([prediction], [grid], "band").loc[0]
    assert row["log10"] == pytest.approx(1 / 6405) and row["log10_rms"] == pytest.approx(1 / math.sqrt(6405))


def test_only_rows_17_to_37_count():
    grid = np.full(GRID, 10.0)
    grid[[16, 38]] = 60
    for convention in CONVENTIONS:
        assert evaluate_make3d([np.ones((55, 305))], [grid], convention).loc[0, "rmse"] == 0
    for edge in (17, 37):
        changed = np.where(np.arange(55)[:, None] == edge, 60, grid)
        for convention in CONVENTIONS:
            assert evaluate_make3d([np.ones((55, 305))], [changed], convention).loc[0, "rmse"] > 0


def test_predictions_are_clamped_at_70_after_scaling_and_not_from_below():
    grid = np.full(GRID, 10.0)
    prediction = np.ones((21, 305))
    prediction[0, 0], prediction[0, 1] = 1000, 1e-7
    row = evaluate_make3d([prediction], [grid], "band").loc[0]
    assert row["abs_rel"] == pytest.approx((6 + 1) / 6405)
    assert row["log10_rms"] == pytest.approx(math.sqrt((math.log10(7) ** 2 + 7**2) / 6405))


def test_truth_of_0_or_of_70_metres_does_not_count_and_any_between_does():
    grid = np.full(GRID, 10.0)
    grid[20, :4] = 0, 70, 69.999, 1e-6
    grid[20, 4] = np.nan
    assert evaluate_make3d([np.ones((2, 2))], [grid], "band").loc[0, "valid_pixels"] == 6405 - 3


def test_without_median_scaling_metres_are_metres():
    grid = np.full(GRID, 10.0)
    row = evaluate_make3d([np.full((1, 1), 5.0)], [grid], "band", median_scaling=False).loc[0]
    assert row["abs_rel"] == 0.5 and row["scale_ratio"] == 1


def test_photos_without_a_valid_cell_are_skipped_and_named():
    grid = np.full(GRID, 10.0)
    frame = evaluate_make3d([np.ones((4, 4))] * 3, [grid, np.full(GRID, 80.0), grid], "band")
    assert list(frame.index) == [0, 2] and frame.index.name == "image" and frame.attrs["skipped"] == [1]


@pytest.mark.parametrize(
    ("size", "rows"), [((2272, 1704), (710, 1562)), ((568, 426), (177, 390)), ((140, 105), (44, 96)), ((50, 100), (0, 50))]
)
def test_the_band_is_central_and_twice_as_wide_as_high(size, rows):
    photo = np.broadcast_to(np.arange(size[0])[:, None, None], (*size, 3))
    band = visible(photo, "band")
    assert band.shape[1:] == photo.shape[1:] and (band[0, 0, 0], band[-1, 0, 0] + 1) == rows
    assert visible(photo, "whole") is photo


HEIGHT, WIDTH = 568, 426


def scene(v, u):
    """Distance of a street at the place (v, u) of an upright photo, both in 0 … 1: ground, a wall on the left, a far end."""
    y, x = (v - 0.45) * HEIGHT / WIDTH, u - 0.5
    stretch = np.sqrt(1 + (x / 1.2) ** 2 + (y / 1.2) ** 2)
    ground = np.where(y > 0.01, 1.6 * 1.2 / np.maximum(y, 0.01), 1e9)
    wall = np.where(x < -0.02, 3.0 * 1.2 / np.maximum(-x, 0.02), 1e9)
    return np.minimum(np.minimum(ground, wall), 60.0) * stretch


def seen(top, bottom, size):
    """The scene between two heights of the photo, at cells of a map."""
    v = top + (np.arange(size[0])[:, None] + 0.5) / size[0] * (bottom - top)
    return scene(v, (np.arange(size[1])[None] + 0.5) / size[1])


BAND = (177 / HEIGHT, 390 / HEIGHT)


@pytest.mark.parametrize(("convention", "shown"), [("band", BAND), ("whole", (0, 1))])
@pytest.mark.parametrize("size", [(192, 576), (384, 1248)])
def test_what_is_shown_and_what_is_scored_belong_together(convention, shown, size):
    grid = seen(0, 1, GRID)

    def error(prediction, convention=convention):
        return evaluate_make3d([prediction], [grid], convention).loc[0, "abs_rel"]

    right = error(seen(*shown, size))
    assert right < 0.06
    other = {"band": "whole", "whole": "band"}[convention]
    assert error(seen(*shown, size), other) > 2.5 * right
    band = BAND[1] - BAND[0]
    for top in (0, 1 - band) if convention == "band" else (-0.2, 0.2):  # the upper or the lower part of the photo instead
        assert error(seen(top, top + (band if convention == "band" else 1), size)) > 2.5 * right
    assert error(seen(*shown, size)[::-1]) > 2.5 * right
    assert error(seen(*shown, size)[:, ::-1]) > 2.5 * right
    # read in the wrong order of rows and columns
    assert error(seen(*shown, size).reshape(size[::-1])) > 2.5 * right


def test_the_cells_are_the_nearest_and_not_a_mixture():
    prediction = np.where(np.arange(192)[:, None] < 96, 2.0, 50.0) * np.ones((1, 576))
    for convention in CONVENTIONS:
        assert set(np.unique(on_grid(prediction, convention))) == {2.0, 50.0}


def test_bad_input_is_one_clear_error():
    grid, depth = np.full(GRID, 10.0), np.ones((4, 6))
    with pytest.raises(InputError, match="holds 2 predictions but there are 1 ground truths"):
        evaluate_make3d([depth, depth], [grid], "band")
    for wrong in (np.nan, np.inf, 0, -1):
        with pytest.raises(InputError, match="image 1: the depth"):
            evaluate_make3d([depth, np.full_like(depth, wrong)], [grid, grid], "band")
    with pytest.raises(InputError, match="none of the 1 ground truths has a cell between 0 and 70 m"):
        evaluate_make3d([depth], [np.full(GRID, 80.0)], "band")
    with pytest.raises(InputError, match="40x100 pixels has no central band"):
        visible(np.zeros((40, 100, 3)), "band")
