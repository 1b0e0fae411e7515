"""Regions of an image that label maps name (paper, table "Evaluation of SA module in regions")."""

from collections.abc import Sequence

import numpy as np

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import Parts, Pixels

REGIONS = {"Road": (0,), "Tree & grass": (8, 9)}
"""Cityscapes training ids of the paper's regions: with little texture, and with much (docs/protocols.md, "Regions of SA-Attention")."""


def in_regions(label_maps: Sequence[np.ndarray], names: Sequence[object]) -> Parts:
    """Masks of `REGIONS`, for `evaluate_parts`.

    Args:
        label_maps: (H, W) Cityscapes training ids, one for each image, in order.
        names: of the label maps, for the error where one is of another size than its ground truth.
    """

    def parts(number: int, pixels: Pixels) -> dict[str, np.ndarray]:
        labels = label_maps[number]
        if labels.shape != pixels.shape:
            of_labels, of_truth = ("x".join(map(str, shape)) for shape in (labels.shape, pixels.shape))
            sizes = f"the label map is of {of_labels} pixels, the ground truth of {of_truth}"
            raise InputError(f"{names[number]}: {sizes}; make the label maps from the images of this ground truth")
        ids = labels.ravel()[pixels.index]
        return {region: np.isin(ids, classes) for region, classes in REGIONS.items()}

    return parts
