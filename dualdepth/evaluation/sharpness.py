"""How sharp a depth map is: the paper's Tenengrad, and the boundary scores that blur and noise cannot please."""

from collections.abc import Sequence

import cv2
import numpy as np

BOUNDARY_RATIOS = tuple(np.linspace(1.05, 1.25, 10))
"""Ratios of neighbouring depths that make a boundary, as in Depth Pro's evaluation; each counts in proportion to itself."""


def tenengrad(values: np.ndarray, thresholds: Sequence[float]) -> np.ndarray:
    """Σ |G(x, y)| over the pixels of depth or inverse depth (H, W) where G > t (paper, equation "Tenengrad"), for each t.

    G = √(Gx² + Gy²) by 3×3 Sobel filters with their plain taps 1-2-1, borders reflected; t is in units of `values`, eight times the step
    from pixel to pixel. The paper sums |G| where the classic measure sums its square, and says neither t nor what depth is measured in.
    """
    values = np.ascontiguousarray(values, np.float32)
    across, down = (cv2.Sobel(values, cv2.CV_32F, dx, dy, ksize=3, borderType=cv2.BORDER_REFLECT_101) for dx, dy in ((1, 0), (0, 1)))
    gradient = np.hypot(across, down).astype(np.float64)
    return np.array([gradient[gradient > t].sum() for t in thresholds])


def boundary_scores(depth: np.ndarray, truth: np.ndarray) -> dict[str, float]:
    """Precision, recall and F1 of depth boundaries against exact dense depth (Bochkovskii et al. 2024, "Depth Pro", section 4.2).

    Two neighbouring pixels are a boundary where the farther is more than `t` times as far; it is found only where the prediction has it
    between the same two pixels, in the same direction. So neither blur nor invented edges help, and scale does not matter.
    `f1` is the published score, over the four directions and weighted over the ratios. On a road it counts the ground's own slope
    just below the horizon, which rises from row to row by more than such ratios; so the scores named `lateral_` are of left and
    right neighbours alone. Both maps are (H, W) and positive, the truth's sky at some far depth.
    """
    weights = np.array(BOUNDARY_RATIOS) / sum(BOUNDARY_RATIOS)
    found, known = _steps(depth), _steps(truth)
    scores = np.zeros((len(weights), 4))
    for row, ratio in zip(scores, BOUNDARY_RATIOS):
        parts = []
        for predicted, true in zip(found, known):
            predicted, true = predicted > ratio, true > ratio
            both = np.count_nonzero(predicted & true)
            parts.append((both / max(np.count_nonzero(predicted), 1), both / max(np.count_nonzero(true), 1)))
        (precision, recall), lateral = np.mean(parts, axis=0), np.mean(parts[:2], axis=0)
        row[:] = _f1(precision, recall), *lateral, _f1(*lateral)
    return dict(zip(("f1", "lateral_precision", "lateral_recall", "lateral_f1"), (weights @ scores).tolist()))


def _steps(depth: np.ndarray) -> tuple[np.ndarray, ...]:
    """Ratio of each pixel's depth to its neighbour's: right over left, left over right, lower over upper, upper over lower."""
    depth = np.asarray(depth, np.float64)
    right, lower = depth[:, 1:] / depth[:, :-1], depth[1:] / depth[:-1]
    return right, 1 / right, lower, 1 / lower


def _f1(precision: float, recall: float) -> float:
    return 2 * precision * recall / (precision + recall) if precision + recall else 0.0
