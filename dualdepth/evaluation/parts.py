"""Parts of an image: near and far, and regions that label maps name (paper, tables "… distant objects", "… SA module in regions")."""

from collections.abc import Callable, Sequence

import numpy as np

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import Parts, Pixels, errors

FAR = 20.0  # Metres: pixels whose ground truth is more than this are distant (paper).
PARTS = ("<= 20 m", "> 20 m")
REGIONS = {"Road": (0,), "Tree & grass": (8, 9)}
"""Cityscapes training ids of the paper's regions: with little texture, and with much (docs/protocols.md, "Regions of SA-Attention")."""
POLE = 5  # Cityscapes' training id of poles (docs/protocols.md, "Sharpness").


def near_and_far(_: int, pixels: Pixels) -> dict[str, np.ndarray]:
    """Masks of `PARTS`, for `evaluate_parts`; the ground truth says which part a pixel belongs to."""
    far = pixels.ground_truth > FAR
    return dict(zip(PARTS, (~far, far)))


def in_regions(label_map: Callable[[int], np.ndarray], names: Sequence[object]) -> Parts:
    """Masks of `REGIONS`, for `evaluate_parts`. `label_map` gives the map (H, W) of Cityscapes training ids of an image by its place;
    `names` are those of the maps' files."""

    def parts(number: int, pixels: Pixels) -> dict[str, np.ndarray]:
        labels = label_map(number)
        if labels.shape != pixels.shape:
            sizes = "the label map is of {}x{} pixels, the ground truth of {}x{}".format(*labels.shape, *pixels.shape)
            raise InputError(f"{names[number]}: {sizes}; make the label maps from the images of this ground truth")
        ids = labels.ravel()[pixels.index]
        return {region: np.isin(ids, classes) for region, classes in REGIONS.items()}

    return parts


def pole_errors(depth: np.ndarray, truth: np.ndarray, labels: np.ndarray, *, max_depth: float) -> dict[str, float] | None:
    """The seven metrics over the pixels of poles, with their number as `valid_pixels`; None where there are none.

    Of maps (H, W): depth in metres, positive and scaled already; truth in metres, 0 where there is none, which counts below `max_depth`;
    labels, training ids.
    """
    chosen = (labels == POLE) & (truth > 0) & (truth < max_depth)
    if not chosen.any():
        return None
    return errors(truth[chosen].astype(np.float64), depth[chosen].astype(np.float64)) | {"valid_pixels": int(chosen.sum())}
