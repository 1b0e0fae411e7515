"""Make3D: the trained networks, not fine-tuned, on upright photos of another camera in other places."""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd

from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.data.frames import resample
from dualdepth.data.make3d import MAKE3D_PHOTOS, read_photo
from dualdepth.device import default_device
from dualdepth.evaluation.baselines import GRID, depth_sums, mean_depth
from dualdepth.evaluation.depth import resize_bilinear
from dualdepth.evaluation.make3d import CONVENTIONS, FARTHEST, METRICS, ROWS, Convention, evaluate_make3d, visible
from dualdepth.model import load
from dualdepth.run import Run
from dualdepth.tables.make3d_scoring import NOT_RUN, Photos, load_photos, predict_photos, score_make3d
from dualdepth.tables.rows import COMPARISON, compare_trainings, mean_row, seed_label, training_note, training_row, with_paper
from dualdepth.tables.scoring import untrained_net

VARIANTS = ("lr", "dual_no_sa", "dual")


def make3d_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's rows, constants, LR-Net before its training, and the trained networks by both conventions (column `convention`).

    Where the run has no MAKE3D_ROOT our rows have no numbers and say how to get it.
    """
    photos = load_photos(run)
    rows = [constant_row(photos), *mean_rows(run, photos)]
    for convention in CONVENTIONS:
        rows.append(untrained_row(run, seeds, photos, convention))
        rows += [trained_row(run, variant, seeds, photos, convention) for variant in VARIANTS]
    return with_paper("make3d", rows)


def constant_row(photos: Photos | None) -> dict[str, Any]:
    """Constant depth, scaled as the networks are; it is the same by both conventions."""
    row = _row("Constant depth", "either", photos)
    if photos is not None:
        row |= mean_row([_score_constant(1.0, photos, median_scaling=True)], METRICS)
        row["note"] = "any constant, scaled to each photo's median as the networks are"
    return row


def mean_rows(run: Run, photos: Photos | None) -> list[dict[str, Any]]:
    """The mean depth of the training-side laser frames, in metres as it is; no row where there are no such frames."""
    fitted = run.prepared / "baseline_truth.npz"
    if not fitted.exists():
        return []
    row = _row("Train set mean", "either", photos) | {"supervision": "Depth"}
    if photos is not None:
        sums = depth_sums(load_ground_truth(fitted), grid=GRID, max_depth=run.profile.evaluation.max_depth)
        depth = mean_depth(sums, "constant").item()
        row |= mean_row([_score_constant(depth, photos, median_scaling=False)], METRICS)
        row["note"] = f"{depth:.1f} m, mean of training-side laser frames, not scaled"
    return [row]


def untrained_row(run: Run, seeds: Sequence[int], photos: Photos | None, convention: Convention) -> dict[str, Any]:
    """LR-Net of the same seeds before its first step."""
    row = _row("LR-Net, untrained", convention, photos)
    if photos is not None:
        depths = (predict_photos(untrained_net(run, seed), photos.pairs, convention) for seed in seeds)
        row |= mean_row([evaluate_make3d(depth, photos.grids, convention) for depth in depths], METRICS)
        row |= {"seeds": seed_label(seeds), "note": _said(run, photos, "before its first step")}
    return row


def trained_row(run: Run, variant: str, seeds: Sequence[int], photos: Photos | None, convention: Convention) -> dict[str, Any]:
    """A training's mean over photos and seeds; without numbers where the profile does not train it."""
    row = {"variant": variant, **_row(run.profile.variant(variant).label, convention, photos)}
    if variant not in run.profile.train:
        return row | training_row(run, variant, seeds, own_truth=True)
    if photos is not None:
        row |= training_row(run, variant, seeds, scores=partial(score_make3d, convention=convention), columns=METRICS, own_truth=True)
        row["note"] = _said(run, photos, f"{training_note(run, variant, seeds[0], drives=())}, not fine-tuned")
    return row


def _row(method: str, convention: str, photos: Photos | None) -> dict[str, Any]:
    """What all measured rows say; all there is to say without photos."""
    row = {"method": method, "supervision": "-", "convention": convention, "source": "measured"}
    row |= {**dict.fromkeys((*METRICS, "n"), np.nan), "seeds": "", "note": ""}
    return row if photos is not None else row | {"note": NOT_RUN}


def _said(run: Run, photos: Photos, note: str) -> str:
    """The note, which photo was read without its end, and whether some of the published ones are missing."""
    missing = [f"{len(photos.pairs)} of {MAKE3D_PHOTOS} photos"] if not run.profile.world and len(photos.pairs) != MAKE3D_PHOTOS else []
    return "; ".join([note, *(f"{name} is truncated" for name in photos.truncated), *missing])


def _score_constant(depth: float, photos: Photos, *, median_scaling: bool) -> pd.DataFrame:
    maps = [np.full((1, 1), depth)] * len(photos.grids)
    return evaluate_make3d(maps, photos.grids, "band", median_scaling=median_scaling)


def made_from(run: Run, seeds: Sequence[int]) -> dict[str, Any]:
    """What the table is made from, as arguments of `Run.save_table`: weights, and one digest of all photos and grids."""
    photos = load_photos(run)
    weights = [run.weights(v, seed) for v in VARIANTS if v in run.profile.train for seed in seeds]
    return {"inputs": weights if photos else [], "seeds": list(seeds), "photos_sha256": photos.digest if photos else None}


def make3d_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The dual network against LR-Net, paired photo by photo, shown the central band."""
    if load_photos(run) is None:
        return pd.DataFrame([{"a": "dual", "b": "lr", "metric": "", "in_words": NOT_RUN}], columns=COMPARISON)
    return compare_trainings(
        run, [("dual", "lr")], seeds, metrics=["abs_rel"], scores=partial(score_make3d, convention="band"), own_truth=True
    )


class Examples(NamedTuple):
    """Some photos for `plots.depth_comparison`, in the order of its arguments."""

    images: list[np.ndarray]
    """The central bands, (H, W, 3)."""
    truths: list[np.ndarray]
    """The scored rows of the grids in metres, each cell enlarged to its pixels; 0 where nothing is scored."""
    predictions: list[np.ndarray]
    """Depth in metres, scaled and clamped as it is scored."""
    titles: list[str]


def make3d_examples(run: Run, variant: str, seed: int, *, count: int = 3, size: tuple[int, int] = (320, 640)) -> Examples | None:
    """`count` photos, evenly spread, predicted by a training; None where the run has no MAKE3D_ROOT."""
    photos = load_photos(run)
    if photos is None:
        return None
    scores = score_make3d(run, variant, seed, convention="band")
    chosen = scores.index[np.unique(np.linspace(0, len(scores) - 1, count).round().astype(int))]
    pairs = [photos.pairs[i] for i in chosen]
    depths = predict_photos(load(run.weights(variant, seed), default_device(), "float32"), pairs, "band")
    scored = [np.where(photos.grids[i] < FARTHEST, photos.grids[i], 0)[ROWS] for i in chosen]
    return Examples(
        [resample(visible(read_photo(pair.photo), "band"), size) for pair in pairs],
        [cv2.resize(grid, size[::-1], interpolation=cv2.INTER_NEAREST) for grid in scored],
        [np.minimum(resize_bilinear(depth, size) * scores.loc[i, "scale_ratio"], FARTHEST) for i, depth in zip(chosen, depths)],
        [pair.photo.name for pair in pairs],
    )
