"""Depth metrics of regions that label maps name (paper, table "Evaluation of SA module in regions")."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pandas as pd

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import Protocol, errors, valid_pixels

REGIONS = {"Road": (0,), "Tree & grass": (8, 9)}
"""Cityscapes training ids of the paper's regions: with little texture, and with much (docs/protocols.md, "Regions of SA-Attention")."""
LEAST = 1
"""Valid pixels of a region that an image must have to count."""


def evaluate_regions(
    predictions: Sequence[np.ndarray],
    ground_truths: Sequence[np.ndarray],
    label_maps: Sequence[np.ndarray],
    *,
    names: Sequence[str] | None = None,
    least: int = LEAST,
    **protocol: Any,
) -> pd.DataFrame:
    """The seven metrics of each region's pixels in each image.

    The protocol is `evaluate`'s. An assumption, since the paper is silent: each image has one median ratio, of all its valid pixels.

    Args:
        predictions: (h, w) each, positive.
        ground_truths: (H, W) metres each, 0 where there is no measurement.
        label_maps: (H, W) Cityscapes training ids each.
        names: of the images, for messages; else their places.
        least: images with fewer valid pixels of a region have no row for it.
        **protocol: fields of `Protocol`.

    Returns:
        One row per image and region, indexed by (`image`, `region`): the metrics and `valid_pixels`.

    Raises:
        InputError: the numbers of maps differ, a label map is of another size than its ground truth or a prediction cannot be scored
            (its place is named), `least` is not positive, or there is no row at all.
    """
    settings, rows = Protocol(**protocol), {}
    if least < 1:
        raise InputError(f"least {least}: must be 1 or more, since a metric needs a pixel")
    if not len(predictions) == len(ground_truths) == len(label_maps):
        counts = f"{len(predictions)} predictions, {len(ground_truths)} ground truths and {len(label_maps)} label maps"
        raise InputError(f"{counts}; give one of each, in order")
    for number, ground_truth in enumerate(ground_truths):
        labels = label_maps[number]
        if labels.shape != ground_truth.shape:
            sizes = f"the label map is of {_size(labels)} pixels, the ground truth of {_size(ground_truth)}"
            raise InputError(
                f"{names[number] if names else f'image {number}'}: {sizes}; make the label maps from the images of this ground truth"
            )
        try:
            pixels = valid_pixels(predictions[number], ground_truth, settings)
        except InputError as error:
            raise InputError(f"image {number}: {error}") from None
        if pixels is None:
            continue
        ids = labels.ravel()[pixels.index]
        for region, classes in REGIONS.items():
            inside = np.isin(ids, classes)
            if inside.sum() >= least:
                values = errors(pixels.ground_truth[inside], pixels.prediction[inside])
                rows[number, region] = values | {"valid_pixels": int(inside.sum())}
    if not rows:
        raise InputError(
            f"none of the {len(ground_truths)} images has {least} valid pixel{'s' * (least > 1)} of {' or '.join(REGIONS)};"
            " check the label maps, the crop and the depth limits"
        )
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis(["image", "region"])


def _size(values: np.ndarray) -> str:
    return "x".join(map(str, values.shape))
