"""Bootstrap, spread and comparisons of trainings against closed forms."""

import math

import numpy as np
import pytest

from dualdepth.evaluation.statistics import Comparison, compare, mean_std, paired_bootstrap


def test_interval_equals_the_normal_one_for_many_images():
    rng = np.random.default_rng(0)
    a, b = rng.normal(0.2, 0.05, 697), rng.normal(0.19, 0.05, 697)
    result = paired_bootstrap(a, b, seed=1)
    half = 1.96 * (a - b).std() / math.sqrt(697)
    assert result.difference == pytest.approx((a - b).mean())
    assert result.low == pytest.approx(result.difference - half, abs=half * 0.05)
    assert result.high == pytest.approx(result.difference + half, abs=half * 0.05)


def test_agrees_with_drawing_indices_one_by_one():
    rng = np.random.default_rng(3)
    a, b = rng.exponential(1, 12), rng.exponential(1.5, 12)
    means = [np.mean([(a - b)[i] for i in rng.integers(0, 12, 12)]) for _ in range(20000)]
    result = paired_bootstrap(a, b, samples=20000, seed=0)
    np.testing.assert_allclose(result[1:], np.quantile(means, [0.025, 0.975]), atol=0.03)


def test_a_constant_gain_on_hard_and_easy_images_is_certain():
    b = np.random.default_rng(0).uniform(0.05, 0.9, 50)
    result = paired_bootstrap(b + 0.01, b, seed=0)
    np.testing.assert_allclose(result, [0.01] * 3, rtol=1e-9)


def test_mean_and_sample_deviation_over_seeds():
    assert mean_std([0.12, 0.13, 0.14]) == pytest.approx((0.13, 0.01))
    mean, deviation = mean_std([0.12])
    assert mean == 0.12 and math.isnan(deviation)


def test_trainings_are_compared_by_means_over_images_and_the_spread_over_seeds():
    b = np.array([[0.1, 0.2, 0.3, 0.4]] * 3)
    a = b + np.array([[0.01], [0.02], [0.06]]) + [0.004, -0.004, 0.002, -0.002]
    result = compare(a, b)
    assert result.seeds == 3
    assert result.mean_a == pytest.approx(0.28) and result.mean_b == pytest.approx(0.25)
    assert result.difference == pytest.approx(0.03)
    # the seeds' differences 0.01, 0.02, 0.06 are off their mean by -0.02, -0.01, 0.03
    assert result.spread == pytest.approx(math.sqrt((0.02**2 + 0.01**2 + 0.03**2) / 2))


def test_the_spread_is_of_the_paired_difference_so_that_what_a_seed_shares_cancels():
    shared = np.array([[0.0], [0.5], [-0.3]])
    images = np.array([0.1, 0.2, 0.3])
    result = compare(shared + images + 0.01, shared + images)
    assert result.spread == pytest.approx(0, abs=1e-12) and result.difference == pytest.approx(0.01)


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


@pytest.mark.parametrize(
    ("low", "high", "clear"), [(0.01, 0.05, True), (-0.05, -0.01, True), (-0.01, 0.05, False), (0, 0.05, False), (-0.05, 0, False)]
)
def test_clear_of_images_means_that_zero_is_outside_the_interval(low, high, clear):
    assert Comparison(0.1, 0.1, 0.0, low, high, 0.0, 2).clear_of_images is clear


@pytest.mark.parametrize(
    ("seeds", "quantile"), [(2, 12.706204736), (3, 4.3026527297), (5, 2.7764451052), (31, 2.0422724563)]
)  # of Student's t at 0.975, from tables
@pytest.mark.parametrize("sign", [1, -1])
def test_clear_of_seeds_means_that_zero_is_outside_students_interval(seeds, quantile, sign):
    limit = quantile * 0.02 / math.sqrt(seeds)
    for factor, clear in ((1.001, True), (0.999, False)):
        assert bool(Comparison(0.1, 0.1, sign * factor * limit, 0.0, 0.0, 0.02, seeds).clear_of_seeds) is clear


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


def test_one_seed_has_no_spread_and_no_verdict_over_seeds():
    result = compare([[0.2, 0.3, 0.4]], [[0.1, 0.1, 0.1]])
    assert math.isnan(result.spread) and result.seeds == 1
    assert result.clear_of_seeds is None and result.clear_of_images


def test_runs_of_neighbours_widen_the_interval_of_values_that_depend_on_each_other():
    rng = np.random.default_rng(0)
    slow = np.repeat(rng.normal(size=40), 25)  # 40 independent values, each seen 25 times
    zero = np.zeros(1000)
    single, block = (paired_bootstrap(slow, zero, seed=0, block=b) for b in (1, 100))
    expected = 2 * 1.96 * slow.std() / 40**0.5
    assert single.high - single.low == pytest.approx(expected / 5, rel=0.1)
    assert block.high - block.low == pytest.approx(expected, rel=0.3)
    assert single.difference == block.difference == pytest.approx(slow.mean())
    assert paired_bootstrap([1.0, 2.0, 6.0], [0.0] * 3, seed=0, block=9) == pytest.approx((3.0, 3.0, 3.0))  # one run is all there is


def test_blocks_are_circular_runs():
    """Against a slow version: draw starts, take runs, average."""
    values = np.array([1.0, 5.0, 2.0, 8.0, 3.0, 9.0, 4.0])
    rng, means = np.random.default_rng(1), []
    for _ in range(20000):
        starts = rng.integers(0, 7, 3)  # ⌈7 / 3⌉ runs of three
        means.append(np.mean([values[(s + k) % 7] for s in starts for k in range(3)]))
    result = paired_bootstrap(values, np.zeros(7), seed=0, block=3, samples=20000)
    np.testing.assert_allclose(result[1:], np.quantile(means, [0.025, 0.975]), atol=0.1)
