"""The paper's qualitative figures, remade from our own predictions."""

from collections.abc import Sequence

import cv2
import numpy as np

from dualdepth.evaluation.parts import FAR, POLE

Window = tuple[slice, slice]  # Rows and columns of an image.


def around(row: float, column: float, shape: Sequence[int], share: float = 0.3) -> Window:
    """A window of `share` of the image's height and twice as wide, centred as near to (row, column) as the image allows."""
    height = max(round(share * shape[0]), 8)
    width = min(2 * height, shape[1])
    top = int(np.clip(row - height / 2, 0, shape[0] - height))
    left = int(np.clip(column - width / 2, 0, shape[1] - width))
    return np.s_[top : top + height, left : left + width]


def interpolated(sparse: np.ndarray) -> np.ndarray:
    """Laser depth (H, W; 0 = none) between its points, linear in inverse depth; 0 above the highest point. For pictures, not for scores."""
    from scipy.interpolate import griddata
    from scipy.spatial import QhullError

    rows, columns = np.nonzero(sparse)
    grid = np.mgrid[: sparse.shape[0], : sparse.shape[1]]
    try:
        inverse = griddata((rows, columns), 1 / sparse[rows, columns], tuple(grid), method="linear", fill_value=0.0)
    except (QhullError, ValueError):  # too few points, or all on one line
        return sparse
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-3), 0)


def boundary_window(depth: np.ndarray) -> Window:
    """Where depth (H, W) jumps most: the window with the largest steps from left to right, on a logarithmic scale."""
    steps = np.abs(np.diff(np.log(np.maximum(depth, 1e-3)), axis=1)).clip(max=1)
    steps[depth[:, 1:] * depth[:, :-1] <= 0] = 0
    spread = max(0.3 * depth.shape[0], 8) / 3
    density = cv2.GaussianBlur(steps, (0, 0), sigmaX=2 * spread, sigmaY=spread, borderType=cv2.BORDER_CONSTANT)
    row, column = np.unravel_index(density.argmax(), density.shape)
    return around(row + 0.5, column + 1, depth.shape)


def far_window(truth: np.ndarray) -> Window | None:
    """Where most laser points beyond 20 m lie; None where there are none."""
    far = truth > FAR
    return around(*np.argwhere(far).mean(0), truth.shape) if far.any() else None


def pole_window(labels: np.ndarray) -> Window | None:
    """Around the largest pole; None where there is none of 20 pixels or more."""
    count, _, stats, centres = cv2.connectedComponentsWithStats((labels == POLE).astype(np.uint8))
    if count < 2 or stats[1:, cv2.CC_STAT_AREA].max() < 20:
        return None
    column, row = centres[1 + stats[1:, cv2.CC_STAT_AREA].argmax()]
    return around(row, column, labels.shape, 0.5)
