"""Make3D: its photos as a run sees them, predictions of the trained networks, and their scores."""

import hashlib
from collections.abc import Sequence
from functools import lru_cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from dualdepth.data.make3d import PhotoGrid, find_pairs, is_truncated, read_grid, read_photo
from dualdepth.device import default_device
from dualdepth.errors import InputError
from dualdepth.evaluation.make3d import Convention, evaluate_make3d, visible
from dualdepth.files import file_digest, write_json, write_text
from dualdepth.model import DepthModel, load
from dualdepth.run import Run, Sources
from dualdepth.staleness import code_digest
from dualdepth.tables.scoring import is_current

NOT_RUN = "not run: no MAKE3D_ROOT; get it with python data_scripts/download_make3d.py --root DIR"


class Photos(NamedTuple):
    """The photos that are scored, in the order of their names."""

    pairs: tuple[PhotoGrid, ...]
    grids: np.ndarray
    """(N, 55, 305) metres."""
    truncated: tuple[str, ...]
    """Photos that lack their end."""
    digest: str
    """Of all photos and grids."""


def load_photos(run: Run) -> Photos | None:
    """Make3D's photos and grids, or None where the run has no MAKE3D_ROOT; read anew only when a file has changed.

    Raises:
        InputError: a photo without grid or the other way round, a grid that cannot be read, or more truncated photos than the one that
            is published so.
    """
    root = Sources.load(run).make3d_root
    if root is None:
        return None
    pairs = tuple(find_pairs(root))
    stats = [path.stat() for pair in pairs for path in (pair.photo, pair.grid)]
    return _read(pairs, tuple((s.st_size, s.st_mtime_ns) for s in stats))


@lru_cache(maxsize=2)
def _read(pairs: tuple[PhotoGrid, ...], changed: tuple[tuple[int, int], ...]) -> Photos:
    grids = np.stack([read_grid(pair.grid) for pair in pairs])
    truncated = tuple(pair.photo.name for pair in pairs if is_truncated(pair.photo))
    if len(truncated) > 1:
        more = f" and {len(truncated) - 3} more" if len(truncated) > 3 else ""
        raise InputError(
            f"{pairs[0].photo.parent}: {', '.join(truncated[:3])}{more} are truncated; one photo is published so, copy the others again"
        )
    digests = [(pair.name, file_digest(pair.photo), file_digest(pair.grid)) for pair in pairs]
    return Photos(pairs, grids, truncated, hashlib.sha256(str(digests).encode()).hexdigest())


def predict_photos(model: DepthModel, pairs: Sequence[PhotoGrid], convention: Convention) -> np.ndarray:
    """Depth (N, h, w) of what the network is shown of each photo, at its own size, of unknown scale."""

    def read(path: str | Path) -> np.ndarray:
        return visible(read_photo(path), convention)

    return 1.0 / model.disparities([pair.photo for pair in pairs], read=read)


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
    made_from = {"weights": file_digest(weights), "photos": photos.digest, "code": code_digest("predict")}
    if not is_current(path.with_suffix(".json"), made_from):
        depths = predict_photos(load(weights, default_device(), "float32"), photos.pairs, convention)
        write_text(path, evaluate_make3d(depths, photos.grids, convention).to_csv())
        write_json(path.with_suffix(".json"), made_from)
    return pd.read_csv(path, index_col="image")
