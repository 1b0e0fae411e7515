"""Tenengrad and boundary scores against slow references and closed forms."""

import math

import numpy as np
import pytest

from dualdepth.evaluation.sharpness import boundary_scores, tenengrad

SCORES = ("f1", "lateral_precision", "lateral_recall", "lateral_f1")


def slow_tenengrad(values, threshold):
    """The sum with loops; beyond the border the pixels are mirrored about the outermost one."""
    height, width = values.shape

    def at(row, column):
        row, column = abs(row), abs(column)
        return float(values[row if row < height else 2 * height - 2 - row, column if column < width else 2 * width - 2 - column])

    total = 0.0
    for r in range(height):
        for c in range(width):
            across = sum(w * (at(r + k, c + 1) - at(r + k, c - 1)) for k, w in ((-1, 1), (0, 2), (1, 1)))
            down = sum(w * (at(r + 1, c + k) - at(r - 1, c + k)) for k, w in ((-1, 1), (0, 2), (1, 1)))
            strength = math.sqrt(across**2 + down**2)
            total += strength if strength > threshold else 0
    return total


def test_tenengrad_equals_the_slow_sum_at_every_threshold():
    values = np.random.default_rng(0).uniform(0, 10, (9, 13))
    thresholds = [0, 5, 12, 20, 1000]
    result = tenengrad(values, thresholds)
    np.testing.assert_allclose(result, [slow_tenengrad(values, t) for t in thresholds], rtol=1e-5)
    assert result[0] > result[1] > result[2] > result[3] > result[4] == 0


def slow_scores(depth, truth):
    """Depth Pro's formula pixel by pixel: a boundary in a direction is a neighbour there that is more than t times as far."""
    height, width = truth.shape
    ratios = [1.05 + 0.2 * k / 9 for k in range(10)]
    totals = dict.fromkeys(SCORES, 0.0)

    def f1(p, r):
        return 2 * p * r / (p + r) if p + r else 0.0

    for t in ratios:
        precision, recall = {}, {}
        for direction in ((0, 1), (0, -1), (1, 0), (-1, 0)):
            found = known = both = 0
            for r in range(height):
                for c in range(width):
                    other = r + direction[0], c + direction[1]
                    if 0 <= other[0] < height and 0 <= other[1] < width:
                        a, b = depth[other] / depth[r, c] > t, truth[other] / truth[r, c] > t
                        found, known, both = found + a, known + b, both + (a and b)
            precision[direction], recall[direction] = both / max(found, 1), both / max(known, 1)
        weight = t / sum(ratios)
        p, r = sum(precision.values()) / 4, sum(recall.values()) / 4
        side_p, side_r = ((values[0, 1] + values[0, -1]) / 2 for values in (precision, recall))
        for name, value in zip(SCORES, (f1(p, r), side_p, side_r, f1(side_p, side_r))):
            totals[name] += weight * value
    return totals


@pytest.mark.parametrize("seed", range(3))
def test_boundary_scores_equal_the_slow_formula(seed):
    rng = np.random.default_rng(seed)
    truth = 10 * np.exp(rng.normal(0, 0.12, (11, 14)))
    truth[3:8, 4:9] *= 0.6
    depth = truth * np.exp(rng.normal(0, 0.06, truth.shape))
    scores = boundary_scores(depth, truth)
    assert scores == pytest.approx(slow_scores(depth, truth), rel=1e-9)
    assert all(0.1 < value < 0.95 for value in scores.values())


def test_a_flat_map_finds_nothing_and_a_flat_truth_has_nothing():
    flat, box = np.full((40, 60), 40.0), np.full((40, 60), 40.0)
    box[12:28, 20:40] = 10  # boundaries in all four directions
    assert boundary_scores(flat, box) == boundary_scores(box, flat) == dict.fromkeys(SCORES, 0.0)
