"""Near and far parts of an image (paper, table "Evaluation on distant objects")."""

import numpy as np

from dualdepth.evaluation.depth import Pixels

FAR = 20.0
"""Metres: pixels whose ground truth is more than this are distant (paper)."""
PARTS = ("<= 20 m", "> 20 m")


def near_and_far(_: int, pixels: Pixels) -> dict[str, np.ndarray]:
    """Masks of `PARTS`, for `evaluate_parts`; the ground truth says which part a pixel belongs to."""
    far = pixels.ground_truth > FAR
    return dict(zip(PARTS, (~far, far)))
