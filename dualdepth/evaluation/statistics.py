"""How sure a difference is: paired bootstrap over images, mean and spread over seeds."""

from typing import NamedTuple

import numpy as np


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
        """Whether the 95 % t-interval of the mean over seeds excludes zero, which asks of three seeds for a difference of 2.5 times its
        standard deviation; None with one seed."""
        return None if np.isnan(self.spread) else bool(abs(self.difference) > t_interval(self.spread, self.seeds))


def compare(a: np.ndarray, b: np.ndarray, *, seed: int = 0, samples: int = 10000, block: int = 1) -> Comparison:
    """Compare values (S seeds, N images) of two methods, in the same order, by a 95 % percentile bootstrap over images.

    Images are drawn with replacement, both methods' values of an image together, so what makes an image hard cancels. The same `seed` gives
    the same `samples` draws. `block` draws runs of so many neighbours, for values that depend on their neighbours' (circular block
    bootstrap, Politis and Romano 1992).
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    difference, images = a.mean(0) - b.mean(0), a.shape[1]
    block = min(block, images)
    runs = np.concatenate([difference, difference[: block - 1]])
    block_means = np.convolve(runs, np.full(block, 1 / block), mode="valid")  # of the run that begins at each value
    # how often each run is drawn says all about a sample's mean
    count = -(-images // block)
    drawn = np.random.default_rng(seed).multinomial(count, np.full(images, 1 / images), size=samples)
    low, high = np.quantile(drawn @ block_means / count, [(1 - 0.95) / 2, (1 + 0.95) / 2])
    spread = (a - b).mean(axis=1).std(ddof=1) if len(a) > 1 else np.nan
    numbers = (a.mean(), b.mean(), difference.mean(), low, high, spread)
    return Comparison(*map(float, numbers), len(a))
