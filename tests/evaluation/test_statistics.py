"""Bootstrap and spread against closed forms."""

import math

import numpy as np
import pytest

from dualdepth.errors import InputError
from dualdepth.evaluation.statistics import mean_std, paired_bootstrap


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


def test_the_seed_fixes_the_interval():
    a, b = np.random.default_rng(0).random((2, 30))
    assert paired_bootstrap(a, b, seed=4) == paired_bootstrap(a, b, seed=4)
    assert paired_bootstrap(a, b, seed=4) != paired_bootstrap(a, b, seed=5)


@pytest.mark.parametrize("a, b", [([1, 2], [1, 2, 3]), ([1], [1]), ([1, math.nan], [1, 2]), ([[1, 2]], [[1, 2]])])
def test_values_that_are_no_pairs_are_refused(a, b):
    with pytest.raises(InputError, match="paired bootstrap"):
        paired_bootstrap(a, b, seed=0)


def test_mean_and_sample_deviation_over_seeds():
    assert mean_std([0.12, 0.13, 0.14]) == pytest.approx((0.13, 0.01))
    mean, deviation = mean_std([0.12])
    assert mean == 0.12 and math.isnan(deviation)
    with pytest.raises(InputError):
        mean_std([])
