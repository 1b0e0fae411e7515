"""Intervals over images and over seeds against closed forms; means and spread stand in tests/tables/test_table_rows.py."""

import numpy as np
import pytest

from dualdepth.evaluation.statistics import compare


def test_the_interval_is_over_images_of_the_seeds_mean_difference():
    rng = np.random.default_rng(0)
    noise = np.array([[1.0], [-1.0]]) * rng.normal(0, 5, 400)  # cancels over the two seeds
    difference = rng.normal(0.1, 1, 400)
    result = compare(difference + noise, np.zeros((2, 400)))
    half = 1.96 * difference.std() / 20
    assert result.low == pytest.approx(difference.mean() - half, abs=0.1 * half)
    assert result.high == pytest.approx(difference.mean() + half, abs=0.1 * half)
    again = [compare(difference + noise, np.zeros((2, 400)), seed=3)[3:5] for _ in range(2)]
    assert again[0] == again[1] != result[3:5]


def test_students_interval_is_the_one_scipy_makes_of_the_seeds_differences():
    from scipy.stats import ttest_1samp

    verdicts = set()
    for shift in (0.0, 0.01, 0.02, 0.03, 0.05):
        seeds = np.array([[0.01], [0.02], [0.06]]) + shift
        result = compare(seeds + np.zeros(4), np.zeros((3, 4)))
        interval = ttest_1samp(seeds[:, 0], 0).confidence_interval(0.95)
        verdicts.add(bool(result.clear_of_seeds))
        assert bool(result.clear_of_seeds) == (interval.low > 0 or interval.high < 0)
    assert verdicts == {True, False}


@pytest.mark.slow
@pytest.mark.parametrize("block", [1, 3, 7])
def test_blocks_are_circular_runs(block):
    """Against a slow version: draw starts, take runs, average."""
    values = np.array([1.0, 5.0, 2.0, 8.0, 3.0, 9.0, 4.0])
    rng, means = np.random.default_rng(1), []
    for _ in range(20000):
        starts = rng.integers(0, 7, -(-7 // block))
        means.append(np.mean([values[(s + k) % 7] for s in starts for k in range(block)]))
    result = compare(values[None], np.zeros((1, 7)), block=block, samples=20000)
    np.testing.assert_allclose(result[3:5], np.quantile(means, [0.025, 0.975]), atol=0.15)
