"""The depth metrics as slow loops over pixels: the reference of several tests."""

import math


def slow_metrics(pairs):
    """The seven metrics of (truth, prediction) pairs, one by one."""
    n = len(pairs)
    return {
        "abs_rel": sum(abs(g - p) / g for g, p in pairs) / n,
        "sq_rel": sum((g - p) ** 2 / g for g, p in pairs) / n,
        "rmse": math.sqrt(sum((g - p) ** 2 for g, p in pairs) / n),
        "rmse_log": math.sqrt(sum((math.log(g) - math.log(p)) ** 2 for g, p in pairs) / n),
        **{f"a{k}": sum(max(g / p, p / g) < 1.25**k for g, p in pairs) / n for k in (1, 2, 3)},
        "valid_pixels": n,
    }
