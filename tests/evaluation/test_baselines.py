"""Baselines without learning: means of sparse maps by hand, left-out drives by fitting again."""

import numpy as np
import pytest

from dualdepth.errors import InputError
from dualdepth.evaluation.baselines import GRID, depth_sums, leave_one_drive_out, mean_depth
from dualdepth.evaluation.depth import resize_bilinear

SPARSE = [np.array([[0.0, 0, 0, 0], [4, 0, 0, 90], [10, 0, 20, 0]]), np.array([[0.0, 0, 0, 0], [8, 0, 0, 0], [0, 0, 40, 0]])]


def sums_of(maps, grid=(3, 4)):
    return depth_sums(maps, grid=grid, max_depth=80)


def test_means_are_over_valid_pixels_below_the_cap():
    sums = sums_of(SPARSE)
    assert mean_depth(sums, "constant").item() == pytest.approx((4 + 8 + 10 + 20 + 40) / 5)
    np.testing.assert_allclose(mean_depth(sums, "row_mean")[:, 0], [6, 6, 70 / 3], rtol=1e-6)
    expected = [[6, 6, 6, 6], [6, 6, 6, 6], [10, 70 / 3, 30, 70 / 3]]
    np.testing.assert_allclose(mean_depth(sums, "mean_map"), expected, rtol=1e-6)


def test_maps_of_several_sizes_share_the_grid():
    small, large = np.full((3, 4), 10.0), np.full((6, 8), 20.0)
    np.testing.assert_allclose(mean_depth(sums_of([small, large]), "mean_map"), np.full((3, 4), (10 + 4 * 20) / 5))


@pytest.mark.parametrize("baseline", ["constant", "row_mean", "mean_map"])
def test_leaving_a_drive_out_equals_fitting_on_the_others(baseline):
    rng = np.random.default_rng(0)
    shapes = [(12, 16), (12, 16), (10, 16), (12, 16), (12, 18)]
    maps = [np.where(rng.random(s) < 0.5, rng.uniform(1, 79, s), 0) for s in shapes]
    drives = ["a", "b", "a", "c", "b"]
    left_out = leave_one_drive_out(maps, drives, baseline, max_depth=80)
    for depth, drive, prediction in zip(maps, drives, left_out):
        others = [m for m, d in zip(maps, drives) if d != drive]
        assert prediction.shape == depth.shape and prediction.dtype == np.float32 and prediction.min() > 0
        expected = resize_bilinear(mean_depth(sums_of(others, GRID), baseline), depth.shape)
        np.testing.assert_allclose(prediction, expected, rtol=1e-6)


def test_baselines_refuse_what_they_cannot_fit():
    with pytest.raises(InputError, match="no valid depth"):
        mean_depth(sums_of([np.zeros((3, 4))]), "constant")
