"""Make3D's criterion C1: closed forms, and a slow reference."""

import math

import numpy as np
import pytest

from dualdepth.errors import InputError
from dualdepth.evaluation.make3d import CONVENTIONS, evaluate_make3d, visible

GRID = (55, 305)


def sample(seed, size):
    """A positive prediction, and a grid with cells on both sides of 0 and of 70 m."""
    rng = np.random.default_rng(seed)
    grid = rng.uniform(0.5, 85, GRID)
    grid[rng.random(GRID) < 0.1] = 0
    grid[rng.random(GRID) < 0.05] = 70
    prediction = rng.uniform(0.1, 9, size).astype(np.float32)
    prediction[0, 0] = 1e-7  # nothing is clamped from below
    return prediction, grid


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


def test_truth_of_0_or_of_70_metres_does_not_count_and_any_between_does():
    grid = np.full(GRID, 10.0)
    grid[20, :4] = 0, 70, 69.999, 1e-6
    grid[20, 4] = np.nan
    assert evaluate_make3d([np.ones((2, 2))], [grid], "band").loc[0, "valid_pixels"] == 6405 - 3


def test_without_median_scaling_metres_are_metres():
    grid = np.full(GRID, 10.0)
    row = evaluate_make3d([np.full((1, 1), 5.0)], [grid], "band", median_scaling=False).loc[0]
    assert row["abs_rel"] == 0.5 and row["scale_ratio"] == 1


@pytest.mark.parametrize(
    ("size", "rows"), [((2272, 1704), (710, 1562)), ((568, 426), (177, 390)), ((140, 105), (44, 96)), ((50, 100), (0, 50))]
)
def test_the_band_is_central_and_twice_as_wide_as_high(size, rows):
    photo = np.broadcast_to(np.arange(size[0])[:, None, None], (*size, 3))
    band = visible(photo, "band")
    assert band.shape[1:] == photo.shape[1:] and (band[0, 0, 0], band[-1, 0, 0] + 1) == rows
    assert visible(photo, "whole") is photo


def test_photos_without_a_cell_in_range_or_without_a_band_are_refused():
    with pytest.raises(InputError, match="none of the 1 ground truths has a cell between 0 and 70 m"):
        evaluate_make3d([np.ones((4, 6))], [np.full(GRID, 80.0)], "band")
    with pytest.raises(InputError, match="40x100 pixels has no central band"):
        visible(np.zeros((40, 100, 3)), "band")
