"""Make3D: the trained networks, not fine-tuned, on upright photos of another camera in other places."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import NamedTuple

import cv2
import numpy as np
import pandas as pd

from dualdepth.data.frames import resample
from dualdepth.data.make3d import MAKE3D_PHOTOS, PhotoGrid, find_pairs, is_truncated, read_grid, read_photo
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import resize_bilinear
from dualdepth.evaluation.make3d import CONVENTIONS, FARTHEST, METRICS, ROWS, evaluate_make3d, visible
from dualdepth.files import file_digest, short_digest
from dualdepth.model import DepthModel
from dualdepth.run import Run, Sources
from dualdepth.tables.main import fitted_depth
from dualdepth.tables.rows import method_row, with_paper
from dualdepth.tables.scores import SEEDLESS, Scores, Trained, collect, opened, untrained_net

VARIANTS = ("lr", "dual_no_sa", "dual")
NO_PHOTOS = "no MAKE3D_ROOT; get it with python data_scripts/download_make3d.py --root DIR"
UNTRAINED, CONSTANT, MEAN = "LR-Net, untrained", "Constant depth", "Train set mean"


class Photos(NamedTuple):
    """The photos that are scored, in the order of their names."""

    pairs: tuple[PhotoGrid, ...]
    grids: np.ndarray  # (N, 55, 305) metres.
    truncated: tuple[str, ...]  # Photos that lack their end.
    digest: str  # Of all photos and grids.


def load_photos(run: Run) -> Photos | None:
    """Make3D's photos and grids, or None where the run has no MAKE3D_ROOT; read anew only when a file has changed. An `InputError` names a
    photo without grid or the other way round, a grid that cannot be read, or more truncated photos than the one that is published so."""
    root = Sources.load(run).make3d_root
    if root is None:
        return None
    pairs = tuple(find_pairs(root))
    return opened(_read, (pairs,), *(path for pair in pairs for path in (pair.photo, pair.grid)))


def _read(pairs: tuple[PhotoGrid, ...]) -> Photos:
    grids = np.stack([read_grid(pair.grid) for pair in pairs])
    truncated = tuple(pair.photo.name for pair in pairs if is_truncated(pair.photo))
    if len(truncated) > 1:
        shown = ", ".join(truncated[:3]) + (f" and {len(truncated) - 3} more" if len(truncated) > 3 else "")
        raise InputError(f"{pairs[0].photo.parent}: {shown} are truncated; one photo is published so, copy the others again")
    digests = [(pair.name, file_digest(pair.photo), file_digest(pair.grid)) for pair in pairs]
    return Photos(pairs, grids, truncated, short_digest(str(digests)))


def predict_photos(model: DepthModel, pairs: Sequence[PhotoGrid], convention: str) -> np.ndarray:
    """Depth (N, h, w) of what the network is shown of each photo, at its own size, of unknown scale."""
    return 1.0 / model.disparities([pair.photo for pair in pairs], read=lambda path: visible(read_photo(path), convention))


def score_photos(training: Trained, photos: Photos, convention: str) -> pd.DataFrame:
    """Metrics of each photo by a training's weights, kept beside them as `make3d_<convention>.csv` and reused while they fit."""
    return training.kept(f"make3d_{convention}.csv", {"photos": photos.digest}, lambda: _scores(training.model, photos, convention))


def _scores(model: DepthModel, photos: Photos, convention: str) -> pd.DataFrame:
    return evaluate_make3d(predict_photos(model, photos.pairs, convention), photos.grids, convention)


def make3d_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """Scores of the trained networks, of LR-Net before its training, and of constants, by convention (`part`); none without MAKE3D_ROOT."""
    photos = load_photos(run)
    if photos is None:
        scores = collect(run, VARIANTS, seeds, reason=NO_PHOTOS)
        for name in (CONSTANT, MEAN, UNTRAINED):
            scores = scores.plus(name, None, NO_PHOTOS)
        return scores

    def by_convention(score: Callable[[str], pd.DataFrame]) -> pd.DataFrame:
        return pd.concat({c: score(c) for c in CONVENTIONS}, names=["part"]).swaplevel()

    def constant(depth: float, *, median_scaling: bool) -> dict[int, pd.DataFrame]:
        maps = [np.full((1, 1), depth)] * len(photos.grids)
        return {SEEDLESS: by_convention(lambda c: evaluate_make3d(maps, photos.grids, c, median_scaling=median_scaling))}

    scores = collect(run, VARIANTS, seeds, lambda t: by_convention(lambda c: score_photos(t, photos, c)), reason="", drives=())
    untrained = {seed: by_convention(partial(_scores, untrained_net(run, seed), photos)) for seed in seeds}
    scores = scores.plus(UNTRAINED, untrained, "before its first step")
    note = "any constant, scaled to each photo's median as the networks are"
    scores = scores.plus(CONSTANT, constant(1.0, median_scaling=True), note)
    if (mean := fitted_depth(run, "constant")) is None:
        return scores
    note = f"{mean.item():.1f} m, mean of training-side laser frames, not scaled"
    return scores.plus(MEAN, constant(mean.item(), median_scaling=False), note)


def make3d_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's rows, constants, LR-Net before its training, and the trained networks by both conventions (column `convention`).

    Where the run has no MAKE3D_ROOT our rows have no numbers and say how to get it.
    """
    photos = load_photos(run)
    remarks = [f"{name} is truncated" for name in photos.truncated] if photos else []
    if photos and not run.profile.world and len(photos.pairs) != MAKE3D_PHOTOS:
        remarks.append(f"{len(photos.pairs)} of {MAKE3D_PHOTOS} photos")
    shown = [(CONSTANT, "band", "either", "-", ""), (MEAN, "band", "either", "Depth", "")]
    for convention in CONVENTIONS:
        shown.append((UNTRAINED, convention, convention, "-", "; ".join(remarks)))
        shown += [(variant, convention, convention, "-", "; ".join(["not fine-tuned", *remarks])) for variant in VARIANTS]
    rows = []
    for name, part, convention, supervision, note in shown:
        if name != MEAN or fitted_depth(run, "constant") is not None:
            method = run.profile.variant(name).label if name in VARIANTS else name
            row = {"method": method, "supervision": supervision, "convention": convention}
            rows.append(row | method_row(scores, name, METRICS, part, note))
    return with_paper("make3d", rows)


def make3d_examples(training: Trained, *, count: int = 3, size: tuple[int, int] = (320, 640)) -> tuple[list, ...] | None:
    """`count` photos, evenly spread, predicted by a training, as arguments of `plots.depth_comparison`: the central bands (H, W, 3); the
    scored rows of the grids in metres, each cell enlarged to its pixels, 0 where nothing is scored; depth in metres, scaled and clamped
    as it is scored; titles. None where the run has no MAKE3D_ROOT."""
    photos = load_photos(training.run)
    if photos is None:
        return None
    scores = score_photos(training, photos, "band")
    chosen = scores.index[np.unique(np.linspace(0, len(scores) - 1, count).round().astype(int))]
    pairs = [photos.pairs[i] for i in chosen]
    depths = predict_photos(training.model, pairs, "band")
    measured = [np.where(photos.grids[i] < FARTHEST, photos.grids[i], 0)[ROWS] for i in chosen]
    return (
        [resample(visible(read_photo(pair.photo), "band"), size) for pair in pairs],
        [cv2.resize(grid, size[::-1], interpolation=cv2.INTER_NEAREST) for grid in measured],
        [np.minimum(resize_bilinear(depth, size) * scores.loc[i, "scale_ratio"], FARTHEST) for i, depth in zip(chosen, depths)],
        [pair.photo.name for pair in pairs],
    )
