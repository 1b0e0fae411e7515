"""Depth metrics of the Eigen split, to the last quirk of the field's protocol (docs/protocols.md, "Depth on the Eigen split").

Order for each image: resize to the ground truth's size, mask, median ratio, **then** clamp, then the seven metrics; the table has the
plain mean over images. Values are compared in float64.
"""

import math
import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args, get_type_hints

import cv2
import numpy as np
import pandas as pd
from tqdm import tqdm

from dualdepth.errors import InputError, reading

METRICS = ("abs_rel", "sq_rel", "rmse", "rmse_log", "a1", "a2", "a3")
CROPS = {
    "garg": (0.40810811, 0.99189189, 0.03594771, 0.96405229),
    "eigen": (0.3324324, 0.91351351, 0.03594771, 0.96405229),
    "none": (0.0, 1.0, 0.0, 1.0),
}
"""Top, bottom, left, right as shares of the ground truth's height and width."""


@dataclass(frozen=True)
class Protocol:
    """How predictions are scored; the defaults are the field's. An `InputError` unless they are known and 0 < min_depth < max_depth."""

    kind: Literal["depth", "disparity"] = "depth"  # What the predictions are; disparity is inverse depth, of any scale.
    resize: Literal["depth", "disparity"] = "depth"
    """What is resized bilinearly to the ground truth's size: SfMLearner and GeoNet depth, monodepth2 disparity."""
    crop: Literal["garg", "eigen", "none"] = "garg"
    min_depth: float = 1e-3  # Metres; ground truth must be strictly above, predictions are clamped to it.
    max_depth: float = 80.0  # Metres; ground truth must be strictly below, predictions are clamped to it.
    median_scaling: bool = True  # Multiply each prediction by median(ground truth) / median(prediction) over the valid pixels.
    valid: Literal["range", "positive"] = "range"
    """Pixels that count: ground truth strictly between the depths, or all above 0 (for the improved ground truth)."""

    def __post_init__(self) -> None:
        for name, hint in get_type_hints(type(self)).items():
            choices = get_args(hint)
            if choices and getattr(self, name) not in choices:
                raise InputError(f"{name} {getattr(self, name)!r} is unknown: choose one of {', '.join(choices)}")
        if not 0 < self.min_depth < self.max_depth < math.inf:
            raise InputError(f"min_depth {self.min_depth} and max_depth {self.max_depth}: must be 0 < min_depth < max_depth")


class Pixels(NamedTuple):
    """The valid pixels of one image, P of them, as the metrics see them."""

    ground_truth: np.ndarray  # (P,) float64, metres
    prediction: np.ndarray  # (P,) float64, metres, scaled and clamped
    index: np.ndarray  # (P,) places in the flattened (H, W) map, to look up distance, region or label
    scale_ratio: float  # what the prediction was multiplied by; 1 without median scaling
    unscaled: np.ndarray  # (P,) float64, the resized prediction as depth, before it was scaled and clamped
    shape: tuple[int, int]  # (H, W) of the map


Parts = Callable[[int, Pixels], dict[str, np.ndarray]]
"""Gives the parts of an image from its place and its pixels, by name: masks (P,), which may overlap or leave pixels out."""


def crop_box(crop: str, height: int, width: int) -> tuple[slice, slice]:
    """Rows and columns of a crop in a map of `height` × `width` pixels; bounds are truncated to integers."""
    top, bottom, left, right = CROPS[crop]
    return slice(int(top * height), int(bottom * height)), slice(int(left * width), int(right * width))


def errors(ground_truth: np.ndarray, prediction: np.ndarray) -> dict[str, float]:
    """The seven metrics, by the names in `METRICS`, of paired depths (P,) in metres, positive, P ≥ 1; a1, a2, a3 are shares in [0, 1] with
    max(gt/p, p/gt) < 1.25^k, strictly."""
    difference = ground_truth - prediction
    squared = difference**2
    ratio = np.maximum(ground_truth / prediction, prediction / ground_truth)
    values = {
        "abs_rel": (abs(difference) / ground_truth).mean(),
        "sq_rel": (squared / ground_truth).mean(),
        "rmse": squared.mean() ** 0.5,
        "rmse_log": ((np.log(ground_truth) - np.log(prediction)) ** 2).mean() ** 0.5,
        **{f"a{k}": (ratio < 1.25**k).mean() for k in (1, 2, 3)},
    }
    return {name: float(value) for name, value in values.items()}


def resize_bilinear(values: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resize (h, w) float values to `size` = (H, W) bilinearly, without anti-aliasing."""
    return cv2.resize(values, size[::-1], interpolation=cv2.INTER_LINEAR)


def valid_pixels(prediction: np.ndarray, ground_truth: np.ndarray, protocol: Protocol) -> Pixels | None:
    """Pair the valid pixels of one image, with the prediction resized, scaled and clamped by `protocol`; None where no pixel is valid.

    The prediction is (h, w) float depth or disparity of any size, finite and positive; the ground truth (H, W) float, metres, 0 or NaN
    where there is no measurement. An `InputError` says that a shape or the prediction is something else.
    """
    prediction = np.asarray(prediction, np.float64 if prediction.dtype.itemsize > 4 else np.float32)
    if prediction.ndim != 2 or ground_truth.ndim != 2 or 0 in prediction.shape:
        raise InputError(f"shapes {prediction.shape} and {ground_truth.shape}; expected (height, width) for both")
    lowest, highest = prediction.min(), prediction.max()
    # below the smallest normal number the inverse overflows; resized as disparity, 0 is as far as depth is clamped to, as in monodepth2
    if not ((0 if protocol.kind == protocol.resize == "disparity" else 1.2e-38) <= lowest and 1.2e-38 <= highest < math.inf):
        mend = "finite and above 0" + ", or 0 in some pixels with --resize disparity" * (protocol.kind == "disparity")
        raise InputError(f"the {protocol.kind} goes from {lowest:g} to {highest:g}; predictions must be {mend}")

    # compared in the ground truth's own precision: a float32 0.001 is not above 0.001
    above, below = (protocol.min_depth, protocol.max_depth) if protocol.valid == "range" else (0.0, math.inf)
    box = crop_box(protocol.crop, *ground_truth.shape)
    mask = np.zeros_like(ground_truth, dtype=bool)
    mask[box] = (ground_truth[box] > above) & (ground_truth[box] < below)
    index = np.flatnonzero(mask)
    if not len(index):
        return None

    if protocol.kind != protocol.resize:
        prediction = 1 / prediction
    prediction = resize_bilinear(prediction, ground_truth.shape).ravel()[index].astype(np.float64)
    if protocol.resize == "disparity":
        prediction = 1 / np.maximum(prediction, 1.2e-38)
    measured = ground_truth.ravel()[index].astype(np.float64)

    scaled, ratio = scale_and_clamp(measured, prediction, protocol)
    return Pixels(measured, scaled, index, ratio, prediction, ground_truth.shape)


def scale_and_clamp(ground_truth: np.ndarray, prediction: np.ndarray, protocol: Protocol) -> tuple[np.ndarray, float]:
    """The prediction (P,) at the ground truth's median, then clamped, in metres; and the ratio that it was multiplied by."""
    ratio = float(np.median(ground_truth)) / float(np.median(prediction)) if protocol.median_scaling else 1.0
    if ratio < 1e-30:
        raise InputError("the disparity is 0 in most of the pixels to score, so its median says nothing; give disparities above 0")
    return np.clip(prediction * ratio, protocol.min_depth, protocol.max_depth), ratio


def evaluate(predictions: Sequence[np.ndarray] | np.ndarray, ground_truths: Sequence[np.ndarray], **options: Any) -> pd.DataFrame:
    """`evaluate_parts` of all valid pixels, with its arguments and errors: one row per scored image, indexed by its place (`image`)."""
    return evaluate_parts(predictions, ground_truths, whole, **options).droplevel("part")


def whole(_: int, pixels: Pixels) -> dict[str, np.ndarray]:
    """All valid pixels as the one part of an image, for `evaluate_parts`."""
    return {"all": np.ones_like(pixels.index, bool)}


def evaluate_parts(
    predictions: Sequence[np.ndarray] | np.ndarray,
    ground_truths: Sequence[np.ndarray],
    parts: Parts,
    *,
    name: str = "predictions",
    own_ratio: bool = False,
    metrics: Callable[[np.ndarray, np.ndarray], dict[str, float]] = errors,
    required: str = "a valid pixel; check the crop and the depth limits",
    **protocol: Any,
) -> pd.DataFrame:
    """Score parts of each image by the protocol. An assumption, since the paper is silent: all parts of an image share its median ratio.

    Args:
        predictions: (N, h, w) array or N arrays (h, w), depth or disparity.
        ground_truths: N maps (H, W) in metres, 0 where there is no measurement; threads ask for them one by one.
        name: what error messages call the predictions, such as their file.
        own_ratio: scale each part by its own median ratio instead.
        metrics: of paired depths.
        required: what an image must have to be scored, for the message where none has it.
        **protocol: fields of `Protocol`.

    Returns:
        One row per image and part that has pixels, indexed by (`image`, `part`): the metrics, `scale_ratio` and `valid_pixels`.
        `attrs["skipped"]` lists the images without a valid pixel. An `InputError` names the image whose prediction cannot be scored, or
        says that the numbers of maps differ or that no part of any image has a pixel.
    """
    settings, count = Protocol(**protocol), len(predictions)
    if count != len(ground_truths):
        raise InputError(f"{name}: holds {count} predictions but there are {len(ground_truths)} ground truths; give one for each, in order")

    def score(number: int) -> dict[str, dict[str, float]] | None:
        """The row of each part of an image, or None without a valid pixel."""
        ground_truth, rows = ground_truths[number], {}
        try:
            pixels = valid_pixels(predictions[number], ground_truth, settings)
            for part, mask in parts(number, pixels).items() if pixels else ():
                if mask.any():
                    truth, depth, ratio = pixels.ground_truth[mask], pixels.prediction[mask], pixels.scale_ratio
                    if own_ratio:
                        depth, ratio = scale_and_clamp(truth, pixels.unscaled[mask], settings)
                    rows[part] = metrics(truth, depth) | {"scale_ratio": ratio, "valid_pixels": len(truth)}
        except InputError as error:
            raise InputError(f"{name}: image {number}: {error}") from None
        return rows if pixels else None

    with ThreadPoolExecutor(os.cpu_count()) as pool:  # unpacking and resizing let others run; a bar in a pipe would break one-line errors
        images = list(tqdm(pool.map(score, range(count)), "scoring", count, unit="image", disable=None, leave=False))
    rows = {(number, part): row for number, image in enumerate(images) for part, row in (image or {}).items()}
    if not rows:
        raise InputError(f"{name}: none of the {count} ground truths has {required}")
    frame = pd.DataFrame(rows.values(), index=pd.MultiIndex.from_tuples(rows, names=["image", "part"]))
    frame.attrs["skipped"] = [number for number, image in enumerate(images) if image is None]
    return frame


def load_predictions(path: str | Path, *, allow_pickle: bool = False) -> list[np.ndarray]:
    """Open a file of predictions, as the field saves them, without reading it into memory and, unless allowed, without pickle.

    Gives N float arrays (h, w), mapped from the file unless pickled; an axis of one channel, first or last, is taken off. An `InputError`
    says that the file is missing, truncated, no `.npy`, or not float maps of at least one image.
    """
    mend = "give a .npy file with one (N, h, w) float array, as numpy.save writes it, or with --allow-pickle one of maps of several sizes"
    with reading(path, mend):
        values = np.load(path, mmap_mode=None if allow_pickle else "r", allow_pickle=allow_pickle)
        if not isinstance(values, np.ndarray) or not values.ndim:
            raise ValueError("an archive of arrays, or a single number")
        maps = [np.array(m.tolist()) if m.dtype == object else m for m in map(np.asarray, values)]
    maps = [m[0] if m.ndim == 3 and len(m) == 1 else m[..., 0] if m.ndim == 3 and m.shape[2] == 1 else m for m in maps]
    if not maps or any(m.dtype.kind != "f" or m.ndim != 2 or not m.size for m in maps):
        raise InputError(f"{path}: holds {values.dtype} values of shape {values.shape}; {mend}")
    return maps


def summary(frame: pd.DataFrame) -> dict[str, float | int]:
    """Plain means over the scored images of `evaluate`: the seven metrics, `n` scored and `skipped` images, and the median scale ratio; its
    spread is the standard deviation of ratio / median ratio, as monodepth2 prints it."""
    ratio = frame["scale_ratio"]
    return {
        **{name: float(frame[name].mean()) for name in METRICS},
        "n": len(frame),
        "skipped": len(frame.attrs.get("skipped", ())),
        "scale_ratio_median": float(ratio.median()),
        "scale_ratio_spread": float((ratio / ratio.median()).std(ddof=0)),
    }
