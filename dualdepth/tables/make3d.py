"""Make3D: the trained networks, not fine-tuned, on upright photos of another camera in other places."""

import hashlib
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import pandas as pd

from dualdepth.atomic import write_json, write_text
from dualdepth.data import make3d as data
from dualdepth.data.augmentation import resize
from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.data.make3d import Pair, find_pairs, is_truncated, read_grid, read_photo
from dualdepth.errors import InputError
from dualdepth.evaluation import make3d as evaluation
from dualdepth.evaluation.baselines import GRID, depth_sums, mean_depth
from dualdepth.evaluation.depth import resized
from dualdepth.evaluation.make3d import CONVENTIONS, FARTHEST, METRICS, ROWS, Convention, evaluate_make3d, visible
from dualdepth.predict import DepthNet, load_depth_net, predict_disparities
from dualdepth.preparation import Sources
from dualdepth.results import Run, code_digest, file_digest
from dualdepth.scoring import _is_current, device, untrained_net
from dualdepth.tables.rows import COMPARISON, compare_trainings, mean_row, said_seeds, training_note, training_row, with_paper

VARIANTS = ("lr", "dual_no_sa", "dual")
NOT_RUN = "not run: no MAKE3D_ROOT; get it with python data_scripts/download_make3d.py --root DIR"


class Photos(NamedTuple):
    """The photos that are scored, in the order of their names."""

    pairs: tuple[Pair, ...]
    grids: np.ndarray
    """(N, 55, 305) metres."""
    truncated: tuple[str, ...]
    """Photos that lack their end."""
    digest: str
    """Of all photos and grids."""


def load_photos(run: Run) -> Photos | None:
    """Make3D's photos and grids, or None where the run has no MAKE3D_ROOT; read anew only when a file has changed.

    Raises:
        InputError: a photo without grid or the other way round, or a grid that cannot be read.
    """
    root = Sources.load(run).make3d_root
    if root is None:
        return None
    pairs = tuple(find_pairs(root))
    stats = [path.stat() for pair in pairs for path in (pair.photo, pair.grid)]
    return _read(pairs, tuple((s.st_size, s.st_mtime_ns) for s in stats))


@lru_cache(maxsize=2)
def _read(pairs: tuple[Pair, ...], changed: tuple[tuple[int, int], ...]) -> Photos:
    grids = np.stack([read_grid(pair.grid) for pair in pairs])
    truncated = tuple(pair.photo.name for pair in pairs if is_truncated(pair.photo))
    digests = [(pair.name, file_digest(pair.photo), file_digest(pair.grid)) for pair in pairs]
    return Photos(pairs, grids, truncated, hashlib.sha256(str(digests).encode()).hexdigest())


def predict_photos(net: DepthNet, pairs: Sequence[Pair], convention: Convention) -> np.ndarray:
    """Depth (N, h, w) of what the network is shown of each photo, at its own size, of unknown scale."""

    def read(path: str | Path) -> np.ndarray:
        return visible(read_photo(path), convention)

    return 1.0 / predict_disparities(net, [pair.photo for pair in pairs], device=device(), read=read)


def score_make3d(run: Run, variant: str, seed: int, *, convention: Convention) -> pd.DataFrame:
    """Per-photo scores of a training's last weights, kept beside them as `make3d_<convention>.csv` and reused while they fit.

    Raises:
        InputError: the run has no MAKE3D_ROOT, the weights are missing, or a photo cannot be read.
    """
    photos = load_photos(run)
    if photos is None:
        raise InputError(NOT_RUN)
    notebook = "03_train_lr" if run.profile.variant(variant).stage == "lr" else "04_train_hr"
    weights = run.require(run.weights(variant, seed), f"{notebook}, variant {variant}, seed {seed},")
    path = run.training(variant, seed) / f"make3d_{convention}.csv"
    code = [file_digest(Path(module.__file__ or "")) for module in (data, evaluation)]
    made_from = {"weights": file_digest(weights), "photos": photos.digest, "code": [code_digest("predict"), *code]}
    if not _is_current(path.with_suffix(".json"), made_from):
        depths = predict_photos(load_depth_net(weights), photos.pairs, convention)
        write_text(path, evaluate_make3d(depths, photos.grids, convention).to_csv())
        write_json(path.with_suffix(".json"), made_from)
    return pd.read_csv(path, index_col="image")


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
        row |= {"seeds": said_seeds(seeds), "note": _said(photos, "before its first step")}
    return row


def trained_row(run: Run, variant: str, seeds: Sequence[int], photos: Photos | None, convention: Convention) -> dict[str, Any]:
    """A training's mean over photos and seeds; without numbers where the profile does not train it."""
    row = {"variant": variant, **_row(run.profile.variant(variant).label, convention, photos)}
    if variant not in run.profile.train:
        return row | training_row(run, variant, seeds)
    if photos is not None:
        row |= training_row(run, variant, seeds, scores=partial(score_make3d, convention=convention), columns=METRICS)
        row["note"] = _said(photos, f"{training_note(run, variant, seeds[0], drives=())}, not fine-tuned")
    return row


def _row(method: str, convention: str, photos: Photos | None) -> dict[str, Any]:
    """What all measured rows say; all there is to say without photos."""
    row = {"method": method, "supervision": "-", "convention": convention, "source": "measured"}
    row |= {**dict.fromkeys((*METRICS, "n"), np.nan), "seeds": "", "note": ""}
    return row if photos is not None else row | {"note": NOT_RUN}


def _said(photos: Photos, note: str) -> str:
    """The note, and which photos were read without their end."""
    return "; ".join([note, *(f"{name} is truncated" for name in photos.truncated)])


def _score_constant(depth: float, photos: Photos, *, median_scaling: bool) -> pd.DataFrame:
    maps = [np.full((1, 1), depth)] * len(photos.grids)
    return evaluate_make3d(maps, photos.grids, "band", median_scaling=median_scaling)


def make3d_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The dual network against LR-Net, paired photo by photo, shown the central band."""
    if load_photos(run) is None:
        return pd.DataFrame([{"a": "dual", "b": "lr", "metric": "", "in_words": NOT_RUN}], columns=COMPARISON)
    return compare_trainings(run, [("dual", "lr")], seeds, metrics=["abs_rel"], scores=partial(score_make3d, convention="band"))


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
    depths = predict_photos(load_depth_net(run.weights(variant, seed)), pairs, "band")
    scored = [np.where(photos.grids[i] < FARTHEST, photos.grids[i], 0)[ROWS] for i in chosen]
    return Examples(
        [resize(visible(read_photo(pair.photo), "band"), size) for pair in pairs],
        [cv2.resize(grid, size[::-1], interpolation=cv2.INTER_NEAREST) for grid in scored],
        [np.minimum(resized(depth, size) * scores.loc[i, "scale_ratio"], FARTHEST) for i, depth in zip(chosen, depths)],
        [pair.photo.name for pair in pairs],
    )
