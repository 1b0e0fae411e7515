"""Near and far parts of the depth metrics (paper, table "Evaluation on distant objects")."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import Protocol, errors, valid_pixels

FAR = 20.0
"""Metres: pixels whose ground truth is more than this are distant (paper)."""
PARTS = ("<= 20 m", "> 20 m")


def evaluate_near_far(
    predictions: Sequence[np.ndarray], ground_truths: Sequence[np.ndarray], *, own_ratio: bool = False, **protocol: Any
) -> pd.DataFrame:
    """The seven metrics of the near and the far pixels of each image.

    The protocol is `evaluate`'s; the ground truth says which part a pixel belongs to. An assumption, since the paper is silent: each image
    has one median ratio, of all its valid pixels; with `own_ratio` each part has its own.

    Args:
        predictions: (h, w) each, positive.
        ground_truths: (H, W) metres each, 0 where there is no measurement.
        own_ratio: scale each part by its own median ratio.
        **protocol: fields of `Protocol`.

    Returns:
        One row per image and part that has pixels, indexed by (`image`, `distance`): the metrics and `valid_pixels`.

    Raises:
        InputError: the numbers of maps differ, a prediction cannot be scored (its place is named), or no image has a valid pixel.
    """
    settings, rows = Protocol(**protocol), {}
    if len(predictions) != len(ground_truths):
        raise InputError(f"{len(predictions)} predictions but {len(ground_truths)} ground truths; give one for each, in order")
    for number, ground_truth in enumerate(ground_truths):
        try:
            pixels = valid_pixels(predictions[number], ground_truth, settings)
        except InputError as error:
            raise InputError(f"image {number}: {error}") from None
        if pixels is None:
            continue
        far = pixels.ground_truth > FAR
        for part, mask in zip(PARTS, (~far, far)):
            if mask.any():
                truth, depth = pixels.ground_truth[mask], pixels.prediction[mask]
                if own_ratio and settings.median_scaling:
                    raw = pixels.unscaled[mask]
                    depth = np.clip(raw * (np.median(truth) / np.median(raw)), settings.min_depth, settings.max_depth)
                rows[number, part] = errors(truth, depth) | {"valid_pixels": int(mask.sum())}
    if not rows:
        raise InputError(f"none of the {len(ground_truths)} ground truths has a valid pixel; check the crop and the depth limits")
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["image", "distance"])
