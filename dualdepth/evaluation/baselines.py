"""Depth predictions without learning, which every trained model has to beat: constant, per-row mean, train-set mean map.

All three are means of sparse ground truth: sums and counts on a grid that is laid over the image, so that images of several sizes can be
mixed and a frame's own drive can be left out by subtraction.
"""

from collections.abc import Iterable, Sequence

import numpy as np

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import resize_bilinear

GRID = (47, 156)  # Cells of about 8 × 8 KITTI pixels: sparse scans of few frames fill them; from 4 to 32 pixels the scores hardly change.


def depth_sums(maps: Iterable[np.ndarray], *, grid: tuple[int, int] = GRID, max_depth: float) -> np.ndarray:
    """Gather sparse depth maps (H, W) in metres, 0 where there is no measurement, of any sizes, on a grid of (h, w) cells over the image:
    (2, h, w) float64, the sum of the depths strictly between 0 and `max_depth` in each cell, in metres, and their number."""
    sums = np.zeros((2, *grid))
    for depth in maps:
        rows, columns = np.nonzero((depth > 0) & (depth < max_depth))
        cell = rows * grid[0] // depth.shape[0] * grid[1] + columns * grid[1] // depth.shape[1]
        for values, weights in zip(sums, (depth[rows, columns].astype(np.float64), None)):
            values += np.bincount(cell, weights, minlength=values.size).reshape(grid)
    return sums


def mean_depth(sums: np.ndarray, baseline: str) -> np.ndarray:
    """A baseline's depth on the grid: (1, 1), (h, 1) or (h, w) float32, metres, all positive; `resize_bilinear` makes it an image's.

    It is the mean over everything; over each row of the grid, a row without a measurement taking the nearest row that has one; or over
    each cell, a cell without one taking its row's mean (`constant`, `row_mean`, `mean_map`). Without any depth it is an `InputError`.
    """
    total, count = sums
    if not count.any():
        raise InputError("the training ground truth has no valid depth, so no baseline can be fitted; give frames with laser scans")
    if baseline == "constant":
        return np.full((1, 1), total.sum() / count.sum(), np.float32)
    measured = np.flatnonzero(count.sum(axis=1))
    nearest = measured[np.abs(np.arange(len(count))[:, None] - measured).argmin(axis=1)]
    row_mean = (total.sum(axis=1)[nearest] / count.sum(axis=1)[nearest])[:, None]
    if baseline == "row_mean":
        return row_mean.astype(np.float32)
    return np.where(count > 0, total / np.maximum(count, 1), row_mean).astype(np.float32)


def leave_one_drive_out(maps: Sequence[np.ndarray], drives: Sequence[str], baseline: str, *, max_depth: float) -> list[np.ndarray]:
    """Predict each map from the maps of all the other drives, where there are no separate training frames.

    Of maps (H, W) and the drive of each, as in `Frame.drive`, two drives or more; the rest is as for `depth_sums` and `mean_depth`.
    Predictions have the maps' sizes, in metres; those of one drive and size share one array.
    """
    of_drive = {d: depth_sums((m for m, its in zip(maps, drives) if its == d), max_depth=max_depth) for d in dict.fromkeys(drives)}
    others = {drive: sum(of_drive.values()) - sums for drive, sums in of_drive.items()}
    wanted = [(drive, depth.shape) for drive, depth in zip(drives, maps)]
    predictions = {(drive, size): resize_bilinear(mean_depth(others[drive], baseline), size) for drive, size in set(wanted)}
    return [predictions[key] for key in wanted]
