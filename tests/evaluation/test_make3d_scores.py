"""Make3D's criterion C1: closed forms, and a slow reference."""

import math

import numpy as np
import pytest
from slow_metrics import slow_metrics

from dualdepth.errors import InputError
from dualdepth.evaluation.make3d import CONVENTIONS, evaluate_make3d, visible

GRID = (55, 305)


def sample(seed, size):
    """A positive prediction, and a grid with cells of 0, of 70 m, near and beyond these, and unknown ones."""
    rng = np.random.default_rng(seed)
    grid = rng.uniform(0.5, 85, GRID)
    for value in (0, 1e-6, 69.999, 70, np.nan):
        grid[rng.random(GRID) < 0.05] = value
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
    pairs = list(zip(gts, preds))
    scores = {name: slow_metrics(pairs)[name] for name in ("abs_rel", "sq_rel", "rmse", "valid_pixels")}
    digits = [abs(math.log10(g) - math.log10(p)) for g, p in pairs]
    log10_rms = math.sqrt(sum(digit**2 for digit in digits) / len(pairs))
    return scores | {"log10_rms": log10_rms, "log10": sum(digits) / len(pairs), "scale_ratio": ratio}


@pytest.mark.parametrize("convention", CONVENTIONS)
@pytest.mark.parametrize("size", [(192, 640), (384, 1248), (128, 416), (64, 192), (21, 305), (7, 11)])
def test_scores_equal_a_slow_reference(convention, size):
    prediction, grid = sample(size[0], size)
    row = evaluate_make3d([prediction], [grid], convention).loc[0]
    assert row.to_dict() == pytest.approx(slow(prediction, grid, convention))


@pytest.mark.parametrize(("size", "rows"), [((2272, 1704), (710, 1562)), ((140, 105), (44, 96)), ((50, 100), (0, 50))])
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
