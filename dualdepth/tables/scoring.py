"""Measured rows of the tables: predictions of a training, of an untrained network, and of baselines without learning."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import torch
from pydantic import BaseModel, ValidationError

from dualdepth.data.depth_maps import DepthMaps, load_ground_truth
from dualdepth.data.kitti import Frame, image_path
from dualdepth.data.label_maps import label_path, read_label_map
from dualdepth.device import default_device
from dualdepth.errors import InputError, first_mistake
from dualdepth.evaluation import baselines
from dualdepth.evaluation.depth import METRICS, evaluate, resize_bilinear
from dualdepth.evaluation.leaks import check_leak
from dualdepth.files import atomic_path, file_digest, write_json, write_text
from dualdepth.model import DepthModel, load
from dualdepth.networks.architecture import Architecture
from dualdepth.run import Run, Sources
from dualdepth.staleness import code_digest
from dualdepth.training.weights import load_card


class ScoredList(BaseModel):
    """What `test_frames.json` says."""

    listed: int
    """Frames that the list named."""
    frames: list[Frame]
    """Those of them that are scored."""


def scored_list(run: Run) -> ScoredList:
    """The frames that are scored and how many were listed (notebook 02).

    Raises:
        InputError: the file is not there, or is something else.
    """
    path = run.require(run.prepared / "test_frames.json", "02_prepare_data")
    try:
        return ScoredList.model_validate_json(path.read_bytes())
    except ValidationError as error:
        raise InputError(f"{path}: {first_mistake(error)}; run notebook 02_prepare_data again") from None


def scored_frames(run: Run) -> list[Frame]:
    """The frames that are scored, in the ground truth's order (notebook 02)."""
    return scored_list(run).frames


def scored_drives(run: Run) -> list[str]:
    """Drives of the frames that are scored."""
    return sorted({frame.drive for frame in scored_frames(run)})


def scored_note(run: Run) -> str:
    """What a table must say when an incomplete list is scored ("25 of 697"), else nothing."""
    found = scored_list(run)
    return "" if len(found.frames) == found.listed else f"{len(found.frames)} of {found.listed} frames"


def truth(run: Run) -> DepthMaps:
    """Ground truth of the scored frames (notebook 02)."""
    return load_ground_truth(run.require(run.prepared / "ground_truth.npz", "02_prepare_data"))


def image_paths(run: Run) -> list[Path]:
    """Image files of the scored frames."""
    root = Sources.load(run).kitti_root
    return [path for frame in scored_frames(run) if (path := image_path(root, frame))]


def dense_truth(run: Run, image: int) -> np.ndarray | None:
    """Exact depth (H, W) of a scored image in metres, 0 in the sky: the synthetic world has it, real KITTI does not."""
    frame = scored_frames(run)[image]
    path = run.work / "miniature" / "dense_depth" / frame.drive.split("/")[-1] / f"{frame.index:010d}.npy"
    return np.load(path) if run.profile.world else None


def label_map(run: Run, image: int) -> np.ndarray | None:
    """Cityscapes training ids (H, W) of a scored image, or None where the run has no label maps; the synthetic world has them."""
    root = Sources.load(run).labels_root
    return read_label_map(label_path(root, scored_frames(run)[image])) if root else None


def score_training(run: Run, variant: str, seed: int) -> pd.DataFrame:
    """Predict and score the test frames with a training's last weights; both are kept beside the weights and reused while they fit.

    Writes `disparities.npy` (N, h, w) as the field saves it, and `per_image.csv`.

    Raises:
        InputError: the weights are missing, or were trained on drives of the test frames.
    """
    stage = run.profile.variant(variant).stage
    weights = run.require(
        run.weights(variant, seed), f"{'03_train_lr' if stage == 'lr' else '04_train_hr'}, variant {variant}, seed {seed},"
    )
    check_leak(load_card(weights), scored_drives(run), allow=Sources.load(run).allow_leak, weights=weights)
    folder = run.training(variant, seed)
    made_from = {"weights": file_digest(weights), "truth": file_digest(run.prepared / "ground_truth.npz")}
    made_from |= {"evaluation": run.profile.digest("evaluation"), "code": code_digest("predict")}
    if is_current(folder / "per_image.json", made_from):
        return pd.read_csv(folder / "per_image.csv", index_col="image")
    disparities = load(weights, default_device(), "float32").disparities(image_paths(run))
    with atomic_path(folder / "disparities.npy") as partial:
        np.save(partial, disparities)
    if run.profile.data.has_truth:
        scores = evaluate(
            disparities, truth(run), name=str(folder / "disparities.npy"), kind="disparity", **run.profile.evaluation.model_dump()
        )
    else:
        scores = unscored(disparities)
    write_text(folder / "per_image.csv", scores.to_csv())
    write_json(folder / "per_image.json", made_from)
    return scores


SHOWN_MEDIAN = 10.0
"""Median depth that a map without ground truth is shown with: its scale is unknown, and the colour scale goes from 3 to 80."""


def unscored(disparities: np.ndarray) -> pd.DataFrame:
    """The frame of `evaluate` for images (N, h, w) without ground truth: no metric has a value, `scale_ratio` gives `SHOWN_MEDIAN`."""
    frame = pd.DataFrame({name: np.nan for name in METRICS}, index=pd.RangeIndex(len(disparities), name="image"))
    return frame.assign(scale_ratio=[SHOWN_MEDIAN * float(np.median(disparity)) for disparity in disparities], valid_pixels=0)


def depth_unit(run: Run) -> str:
    """What the colour bar of a run's depth maps says behind its numbers."""
    return "m" if run.profile.data.has_truth else f"(scale unknown: median {SHOWN_MEDIAN:g})"


class Predictions:
    """What a training predicts for the scored frames, with the ratios that its scoring found."""

    def __init__(self, run: Run, variant: str, seed: int) -> None:
        self.scores = score_training(run, variant, seed)
        """Per image, indexed by its place among the scored frames."""
        self.disparities = np.load(run.training(variant, seed) / "disparities.npy", mmap_mode="r")
        """(N, h, w) at the network's own size."""
        self._settings, self._truth = run.profile.evaluation, truth(run)

    def depth(self, image: int, size: tuple[int, int] | None = None) -> np.ndarray:
        """Depth of a scored image in metres, median-scaled and clamped as it is scored, resized to `size` (H, W) or the ground truth's.

        Without ground truth its unit is a tenth of the map's median.
        """
        settings, size = self._settings, size or self._truth[image].shape
        disparity = np.asarray(self.disparities[image])
        enlarged = resize_bilinear(1.0 / disparity, size) if settings.resize == "depth" else 1.0 / resize_bilinear(disparity, size)
        return np.clip(enlarged * self.scores.loc[image, "scale_ratio"], settings.min_depth, settings.max_depth)


def untrained_net(run: Run, seed: int) -> DepthModel:
    """LR-Net of a seed before its first step."""
    torch.manual_seed(seed)
    training = run.profile.training
    architecture = Architecture(network="lr", encoder=training.encoder)
    card = architecture.model_dump() | {"hr_size": run.profile.data.hr_size}
    return DepthModel(card, architecture.build(training.pretrained), device=default_device(), precision="float32")


def score_untrained(run: Run, seed: int) -> pd.DataFrame:
    """Score LR-Net of the same seed before its first step: what the architecture alone gives."""
    disparities = untrained_net(run, seed).disparities(image_paths(run))
    return evaluate(disparities, truth(run), name="untrained", kind="disparity", **run.profile.evaluation.model_dump())


def score_baselines(run: Run) -> dict[str, pd.DataFrame]:
    """Score constant depth, per-row mean and mean depth map, by name.

    They are fitted on training-side laser frames; where the only laser frames are the scored ones, each drive is predicted from
    the others. Empty where both fail, no training-side scans and one scored drive, and where there is no ground truth.
    """
    if not run.profile.data.has_truth:
        return {}
    maps, limit = truth(run), run.profile.evaluation.max_depth
    fitted = run.prepared / "baseline_truth.npz"
    scores: dict[str, pd.DataFrame] = {}
    if not fitted.exists() and len({frame.drive for frame in scored_frames(run)}) < 2:
        return scores
    for name in baselines.BASELINES:
        if fitted.exists():
            sums = baselines.depth_sums(load_ground_truth(fitted), grid=baselines.GRID, max_depth=limit)
            predictions: Sequence[np.ndarray] = [baselines.predict(sums, name, depth.shape) for depth in maps]
        else:
            drives = [frame.drive for frame in scored_frames(run)]
            predictions = baselines.leave_one_drive_out(list(maps), drives, name, grid=baselines.GRID, max_depth=limit)
        scores[name] = evaluate(predictions, maps, name=name, kind="depth", **run.profile.evaluation.model_dump())
    return scores


def is_current(path: Path, made_from: dict[str, Any]) -> bool:
    """Whether a kept file was made from just this, as the JSON beside it says."""
    try:
        return json.loads(path.read_text(encoding="utf-8")) == made_from
    except (OSError, ValueError):
        return False
