"""Sharpness: the paper's Tenengrad in every reading of it, and measures that blur cannot please."""

from collections.abc import Iterator, Sequence
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
import pandas as pd

from dualdepth import paper
from dualdepth.evaluation.depth import METRICS, resize_bilinear
from dualdepth.evaluation.regions import POLE, class_errors
from dualdepth.evaluation.sharpness import boundary_scores, tenengrad
from dualdepth.evaluation.statistics import mean_std
from dualdepth.run import Run
from dualdepth.tables.rows import COMPARISON, NO_TRUTH, compare_trainings, mean_row, seed_label, training_note, training_row, with_paper
from dualdepth.tables.scoring import Predictions, dense_truth, label_map, scored_frames

ROWS = {"lr": "w/o HR-Net", "dual": "w/ HR-Net"}
THRESHOLDS = {"depth, m": (0, 2, 5, 10, 20, 50, 100), "inverse depth / its mean": (0, 0.1, 0.25, 0.5, 1, 2, 4)}
"""t of the sweep, in the unit of the map; a Sobel filter's answer is eight times the step from pixel to pixel."""
SIZES = ("native", "common")
"""Each map at its own size, or all at HR-Net's."""


def _maps(run: Run, variant: str, seed: int) -> Iterator[tuple[str, str, np.ndarray]]:
    """(map, size, values) of every scored image of a training."""
    predicted = Predictions(run, variant, seed)
    for image in predicted.scores.index:
        for size in SIZES:
            shape = predicted.disparities[image].shape if size == "native" else run.profile.data.hr_size
            inverse = resize_bilinear(np.asarray(predicted.disparities[image]), shape)
            yield "depth, m", size, predicted.depth(image, shape)
            yield "inverse depth / its mean", size, inverse / inverse.mean()


def sharpness_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's two rows, and ours for each map, size and threshold: mean Tenengrad and the ratio w/ over w/o HR-Net.

    Means and standard deviations are over seeds. `closest` marks the reading whose ratio is nearest to the paper's; the numbers
    themselves cannot be compared (docs/protocols.md, "Sharpness").
    """
    missing = [variant for variant in ROWS if variant not in run.profile.train]
    if missing or not run.profile.data.has_truth:
        note = f"not run: profile {run.profile.name} does not train {', '.join(missing)}" if run.profile.data.has_truth else NO_TRUTH
        rows = [{"method": method, "source": "measured", "note": note} for method in ROWS.values()]
    else:
        rows = _measured_rows(run, seeds)
    table = with_paper("sharpness", rows)
    published = paper.table("sharpness").set_index("method")["tenengrad"]
    paper_ratio = published["w/ HR-Net"] / published["w/o HR-Net"]
    columns = ["map", "size", "threshold", "tenengrad_std", "ratio", "ratio_std", "closest", "n", "seeds"]
    table = table.reindex(columns=[*table.columns, *(c for c in columns if c not in table)])
    table.loc[table["source"] == "paper", "ratio"] = [np.nan, paper_ratio]
    ours = table.loc[(table["source"] == "measured") & (table["ratio"] > 0), "ratio"]
    table["closest"] = table.index.isin([np.abs(np.log(ours / paper_ratio)).idxmin()] if len(ours) else [])
    return table


def _measured_rows(run: Run, seeds: Sequence[int]) -> list[dict[str, Any]]:
    sums: dict[tuple[str, str, str, int], list[np.ndarray]] = {}
    for variant in ROWS:
        for seed in seeds:
            for kind, size, values in _maps(run, variant, seed):
                sums.setdefault((kind, size, variant, seed), []).append(tenengrad(values, THRESHOLDS[kind]))
    rows = []
    for kind, thresholds in THRESHOLDS.items():
        for size in SIZES:
            # (seeds, thresholds) of each network
            low, high = (np.array([np.mean(sums[kind, size, variant, seed], axis=0) for seed in seeds]) for variant in ROWS)
            ratios = np.divide(high, low, out=np.full_like(high, np.nan), where=low > 0)
            for place, t in enumerate(thresholds):
                images = len(sums[kind, size, "lr", seeds[0]])
                shared = {"map": kind, "size": size, "threshold": t, "n": images, "seeds": seed_label(seeds), "source": "measured"}
                for variant, values in (("lr", low), ("dual", high)):
                    row = {"method": ROWS[variant], **shared, "note": training_note(run, variant, seeds[0])}
                    row["tenengrad"], row["tenengrad_std"] = mean_std(values[:, place])
                    if variant == "dual":
                        row["ratio"], row["ratio_std"] = mean_std(ratios[:, place])
                    rows.append(row)
    return rows


BOUNDARY_COLUMNS = ("f1", "lateral_precision", "lateral_recall", "lateral_f1")


@lru_cache(maxsize=64)
def score_boundaries(run: Run, variant: str, seed: int) -> pd.DataFrame:
    """Boundary scores of each scored image against exact dense depth; kept while the run is open, since several rows ask for them."""
    predicted = Predictions(run, variant, seed)
    rows = {i: boundary_scores(predicted.depth(i, e.shape), e) for i in predicted.scores.index for e in [_exact(run, i)]}
    return _per_image(rows, BOUNDARY_COLUMNS)


def score_ceiling(run: Run, size: tuple[int, int]) -> pd.DataFrame:
    """Boundary scores of exact depth itself, shrunk to a network's size and enlarged again: what that size could reach at best."""
    rows = {}
    for image in range(len(scored_frames(run))):
        exact = _exact(run, image)
        shrunk = 1 / cv2.resize(1 / exact, size[::-1], interpolation=cv2.INTER_AREA)
        rows[image] = boundary_scores(resize_bilinear(shrunk, exact.shape), exact)
    return _per_image(rows, BOUNDARY_COLUMNS)


def _exact(run: Run, image: int) -> np.ndarray:
    """Exact depth (H, W) of an image; the sky counts as the farthest depth."""
    exact, farthest = dense_truth(run, image), run.profile.evaluation.max_depth
    return np.where(exact > 0, np.minimum(exact, farthest), farthest)


@lru_cache(maxsize=64)
def score_poles(run: Run, variant: str, seed: int) -> pd.DataFrame:
    """Depth metrics of the pixels of poles in each scored image that has some, against exact dense depth."""
    predicted, rows = Predictions(run, variant, seed), {}
    for image in predicted.scores.index:
        exact, labels = dense_truth(run, image), label_map(run, image)
        depth = predicted.depth(image, exact.shape)
        found = class_errors(depth, exact, labels, [POLE], max_depth=run.profile.evaluation.max_depth)
        if found:
            rows[image] = found
    return _per_image(rows, (*METRICS, "valid_pixels"))


def _per_image(rows: dict[int, dict[str, float]], columns: Sequence[str]) -> pd.DataFrame:
    return pd.DataFrame.from_dict(rows, orient="index", columns=list(columns)).rename_axis("image")


NO_DENSE_TRUTH = "not run: needs exact dense depth, which the laser does not give"


def _no_dense_truth(run: Run) -> str:
    return NO_DENSE_TRUTH if run.profile.data.has_truth else NO_TRUTH


def detail_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """Boundaries and poles of each network against exact depth, and what its size could reach; rows say why where there is none."""
    sizes = {"lr": run.profile.data.lr_size, "dual_no_sa": run.profile.data.hr_size, "dual": run.profile.data.hr_size}
    rows = []
    for variant in sizes:
        method = run.profile.variant(variant).label
        if not run.profile.world:
            rows.append({"method": method, "variant": variant, "source": "measured", "note": _no_dense_truth(run)})
            continue
        row = training_row(run, variant, seeds, scores=score_boundaries, columns=BOUNDARY_COLUMNS)
        poles = training_row(run, variant, seeds, scores=score_poles, columns=("abs_rel", "a1"))
        renamed = {f"pole_{k}": poles[k] for k in ("abs_rel", "abs_rel_std", "a1", "a1_std", "n") if k in poles}
        rows.append({"method": method, **row, **renamed})
    for size in dict.fromkeys(sizes.values()) if run.profile.world else ():
        values = mean_row([score_ceiling(run, size)], BOUNDARY_COLUMNS)
        note = "no network: exact depth shrunk to this size, so the best that it could reach"
        rows.append({"method": f"exact depth at {size[0]}x{size[1]}", **values, "source": "measured", "note": note})
    renamed = {f"{c}{end}": f"boundary_{c}{end}" for c in BOUNDARY_COLUMNS for end in ("", "_std")}
    columns = ["method", "variant", *renamed.values(), "n", "pole_abs_rel", "pole_abs_rel_std", "pole_a1", "pole_a1_std", "pole_n"]
    return pd.DataFrame(rows).rename(columns=renamed).reindex(columns=[*columns, "seeds", "source", "note"])


def detail_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The networks against each other at boundaries and on poles, paired; rows say why where there is no exact depth."""
    pairs = [("dual", "lr"), ("dual_no_sa", "lr"), ("dual", "dual_no_sa")]
    if not run.profile.world:
        rows = [{"of": "boundaries and poles", "a": a, "b": b, "metric": "", "in_words": _no_dense_truth(run)} for a, b in pairs]
        return pd.DataFrame(rows, columns=["of", *COMPARISON])
    boundaries = compare_trainings(run, pairs, seeds, metrics=("f1", "lateral_f1"), scores=score_boundaries)
    poles = compare_trainings(run, pairs, seeds, scores=score_poles)
    return pd.concat([boundaries.assign(of="boundaries"), poles.assign(of="poles")], ignore_index=True)[["of", *COMPARISON]]
