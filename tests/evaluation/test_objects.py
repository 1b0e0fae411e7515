"""Depth of a class's pixels: exactly those, and only where the truth is known and near enough."""

import numpy as np
import pytest

from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.regions import POLE, class_errors


def test_only_pixels_of_the_class_with_truth_in_range_count():
    labels = np.array([[5, 7, 5, 5, 5, 0, 8]], np.uint8)
    truth = np.array([[10, 20, 0, 80, 100, 10, 10]], np.float32)  # a pole and a sign in range; none known; at the limit; beyond it
    depth = np.array([[12, 15, 9, 9, 9, 99, 50]], np.float32)
    found = class_errors(depth, truth, labels, [POLE, 7], max_depth=80)
    assert found["valid_pixels"] == 2  # of both classes together
    assert found["abs_rel"] == pytest.approx((2 / 10 + 5 / 20) / 2)
    assert found["rmse"] == pytest.approx(np.sqrt((4 + 25) / 2)) and found["a1"] == 0.5


def test_exact_depth_scores_zeros_and_ones():
    truth = np.random.default_rng(0).uniform(1, 70, (6, 8)).astype(np.float32)
    found = class_errors(truth, truth, np.full((6, 8), POLE), [POLE], max_depth=80)
    assert [found[name] for name in METRICS] == [0, 0, 0, 0, 1, 1, 1]


@pytest.mark.parametrize(("label", "depth"), [(0, 10.0), (5, 0.0), (5, 80.0), (5, 500.0)])
def test_there_is_no_score_where_no_pixel_counts(label, depth):
    maps = np.full((4, 4), depth), np.full((4, 4), label)
    assert class_errors(np.ones((4, 4)), *maps, [POLE], max_depth=80) is None
