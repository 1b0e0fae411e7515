"""How sure a difference is: paired bootstrap over images, mean and spread over seeds."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np


class Difference(NamedTuple):
    """Mean of a − b and its confidence interval."""

    difference: float
    low: float
    high: float


def paired_bootstrap(
    a: Sequence[float] | np.ndarray, b: Sequence[float] | np.ndarray, *, seed: int, samples: int = 10000, block: int = 1
) -> Difference:
    """95 % percentile bootstrap of the mean difference of two methods over the same images.

    Images are drawn with replacement, both methods' values of an image together, so what makes an image hard cancels.

    Args:
        a, b: (N,) per-image values of both methods, such as the `abs_rel` columns of `evaluate`, in the same order.
        seed, samples: of the draws; the same seed gives the same interval.
        block: draw runs of so many neighbours, for values that depend on their neighbours' (circular block bootstrap, Politis and
            Romano 1992).
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    difference = a - b
    block = min(block, a.size)
    runs = np.concatenate([difference, difference[: block - 1]])
    block_means = np.convolve(runs, np.full(block, 1 / block), mode="valid")  # of the run that begins at each value
    # how often each run is drawn says all about a sample's mean
    count = -(-a.size // block)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(a.size, 1 / a.size), size=samples)
    means = drawn @ block_means / count
    low, high = np.quantile(means, [(1 - 0.95) / 2, (1 + 0.95) / 2])
    return Difference(float(difference.mean()), float(low), float(high))


def mean_std(values: Sequence[float] | np.ndarray) -> tuple[float, float]:
    """Mean and sample standard deviation (n − 1) of a metric over seeds; the deviation of a single seed is NaN."""
    values = np.asarray(values, np.float64)
    return float(values.mean()), float(values.std(ddof=1)) if values.size > 1 else float("nan")


def t_interval(spread: float, seeds: int) -> float:
    """Half the width of the 95 % t-interval of a mean over `seeds` ≥ 2 values with standard deviation `spread`."""
    from scipy.stats import t

    return float(t.ppf(0.975, seeds - 1)) * spread / seeds**0.5


class Comparison(NamedTuple):
    """Two trained methods over the same images and seeds; the difference is a − b."""

    mean_a: float
    mean_b: float
    difference: float
    low: float  # of the 95 % interval of the seeds' mean difference, over images
    high: float
    spread: float  # standard deviation over seeds of the difference; NaN with one seed
    seeds: int

    @property
    def clear_of_images(self) -> bool:
        """Whether the interval over images excludes zero."""
        return self.low > 0 or self.high < 0

    @property
    def clear_of_seeds(self) -> bool | None:
        """Whether the 95 % t-interval of the mean over seeds excludes zero; None with one seed.

        With three seeds that asks for a difference of 2.5 times its standard deviation.
        """
        return None if np.isnan(self.spread) else bool(abs(self.difference) > t_interval(self.spread, self.seeds))


def compare(a: Sequence[Sequence[float]], b: Sequence[Sequence[float]], *, seed: int = 0, block: int = 1) -> Comparison:
    """Compare values (S seeds, N images) of two methods, of the same seeds and images; `seed` and `block` as for `paired_bootstrap`."""
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    spread = mean_std((a - b).mean(axis=1))[1]
    return Comparison(float(a.mean()), float(b.mean()), *paired_bootstrap(a.mean(0), b.mean(0), seed=seed, block=block), spread, len(a))
