"""Depth metrics on Make3D by criterion C1, as monodepth2's authors scored it (docs/protocols.md, "Make3D"; paper, table on Make3D).

The paper only says that photos are resized to the network's input. Both readings are scored on the grid's rows 17:38, the central 21 of 55:

- `band`, monodepth2's and the headline: the photo's central band, twice as wide as high, is resized to the input, and the predicted depth
  to (21, 305). Of an upright 4:3 photo the band is the rows from 31.25 % to 68.75 % (710:1562 of 2272), the grid's 17.2 to 37.8.
- `whole`: the whole photo is resized to the input, and the predicted depth (h, w) to (55, 305), of which rows 17:38 are kept; row r of
  the grid is the prediction's row ⌊r·h/55⌋.

Sizes change to the nearest pixel as OpenCV has it, which is the one at the cell's top left: row r of n is row ⌊r·h/n⌋.
"""

from collections.abc import Sequence

import cv2
import numpy as np
import pandas as pd

from dualdepth.data.make3d import GRID_SHAPE
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import errors, evaluate

CONVENTIONS = ("band", "whole")
METRICS = ("abs_rel", "sq_rel", "rmse", "log10_rms", "log10")
"""`log10_rms` is the root mean square of log10 differences, which papers on self-supervision call log10; `log10` is C1's mean absolute."""
ROWS = slice(17, 38)  # Rows of the laser grid that are scored.
FARTHEST = 70.0  # Metres: the ground truth must be strictly below, predictions are clamped to it from above (C1).
NEAREST = float(np.finfo(np.float64).tiny)  # C1 has no bound below: the ground truth must be above 0.


def visible(photo: np.ndarray, convention: str) -> np.ndarray:
    """What the network is shown of a photo (H, W, 3): all of it, or its central band (W // 2, W, 3); an `InputError` if it is lower."""
    if convention == "whole":
        return photo
    height, width = photo.shape[:2]
    if height < width // 2:
        raise InputError(f"a photo of {height}x{width} pixels has no central band twice as wide as high; Make3D's photos are upright")
    top = (height - width // 2) // 2
    return photo[top : top + width // 2]


def c1_errors(ground_truth: np.ndarray, prediction: np.ndarray) -> dict[str, float]:
    """`METRICS` of paired depths (P,) in metres."""
    digits = np.log10(ground_truth) - np.log10(prediction)
    scores = errors(ground_truth, prediction)
    scores |= {"log10_rms": float(np.sqrt((digits**2).mean())), "log10": float(np.abs(digits).mean())}
    return {name: scores[name] for name in METRICS}


def evaluate_make3d(
    predictions: Sequence[np.ndarray], grids: Sequence[np.ndarray], convention: str, *, median_scaling: bool = True
) -> pd.DataFrame:
    """Score depth predictions against laser grids, photo by photo: the frame of `evaluate` with these `METRICS`, of at most 6405 cells.

    Predictions are (h, w) depths of what is `visible` by the convention, positive, of any size, and of any scale unless `median_scaling` is
    off; grids (55, 305) metres. An `InputError` says that the numbers differ, a prediction is not finite and positive, or no photo has a
    valid cell.
    """
    shape, scored = (GRID_SHAPE, ROWS) if convention == "whole" else ((ROWS.stop - ROWS.start, GRID_SHAPE[1]), np.s_[:])
    cells = [cv2.resize(prediction, shape[::-1], interpolation=cv2.INTER_NEAREST)[scored] for prediction in predictions]
    truths = [np.asarray(grid[ROWS], np.float64) for grid in grids]
    required = f"a cell between 0 and {FARTHEST:g} m in rows 17:38"
    protocol = {"crop": "none", "min_depth": NEAREST, "max_depth": FARTHEST, "median_scaling": median_scaling}
    return evaluate(cells, truths, metrics=c1_errors, required=required, **protocol)
