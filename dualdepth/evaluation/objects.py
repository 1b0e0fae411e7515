"""Depth of the pixels of a class, against exact dense depth: are slim objects seen at all?"""

from collections.abc import Sequence

import numpy as np

from dualdepth.evaluation.depth import errors

POLE = 5
"""Cityscapes' training id of poles (docs/protocols.md, "Sharpness")."""


def class_errors(
    depth: np.ndarray, truth: np.ndarray, labels: np.ndarray, classes: Sequence[int], *, max_depth: float
) -> dict[str, float] | None:
    """The seven metrics over the pixels of some classes, with their number as `valid_pixels`; None where there are none.

    Args:
        depth: (H, W) metres, positive, already scaled.
        truth: (H, W) metres, 0 where there is none.
        labels: (H, W) training ids.
        classes: ids that count.
        max_depth: metres; truth must be below.
    """
    chosen = np.isin(labels, classes) & (truth > 0) & (truth < max_depth)
    if not chosen.any():
        return None
    return errors(truth[chosen].astype(np.float64), depth[chosen].astype(np.float64)) | {"valid_pixels": int(chosen.sum())}
