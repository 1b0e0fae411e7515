"""Sharpness: the paper's Tenengrad in every reading of it, and measures that blur cannot please."""

from collections.abc import Iterator, Sequence

import numpy as np
import pandas as pd

from dualdepth import paper
from dualdepth.evaluation.depth import resized
from dualdepth.evaluation.objects import POLE, class_errors
from dualdepth.evaluation.sharpness import boundary_scores, tenengrad
from dualdepth.results import Run
from dualdepth.scoring import Predictions, dense_truth, label_map, scored_frames
from dualdepth.tables.rows import compare_trainings, said_seeds, training_note, training_row, with_paper

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
            inverse = resized(np.asarray(predicted.disparities[image]), shape)
            yield "depth, m", size, predicted.depth(image, shape)
            yield "inverse depth / its mean", size, inverse / inverse.mean()


def sharpness_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's two rows, and ours for each map, size and threshold: mean Tenengrad and the ratio w/ over w/o HR-Net.

    Column `closest` names the readings nearest to the paper: by the ratio, and by both numbers.
    """
    missing = [variant for variant in ROWS if variant not in run.profile.train]
    if missing:
        note = f"not run: profile {run.profile.name} does not train {', '.join(missing)}"
        return with_paper("sharpness", [{"method": method, "source": "measured", "note": note} for method in ROWS.values()])
    sums: dict[tuple[str, str, str], list[np.ndarray]] = {}
    for variant in ROWS:
        for seed in seeds:
            for kind, size, values in _maps(run, variant, seed):
                sums.setdefault((kind, size, variant), []).append(tenengrad(values, THRESHOLDS[kind]))
    rows = []
    for kind, thresholds in THRESHOLDS.items():
        for size in SIZES:
            low, high = (np.mean(sums[kind, size, variant], axis=0) for variant in ROWS)
            for t, a, b in zip(thresholds, low, high):
                shared = {"map": kind, "size": size, "threshold": t, "n": len(scored_frames(run)), "seeds": said_seeds(seeds)}
                for variant, value, ratio in (("lr", a, np.nan), ("dual", b, b / a if a else np.nan)):
                    note = training_note(run, variant)
                    rows.append({"method": ROWS[variant], "tenengrad": value, "ratio": ratio, **shared, "source": "measured", "note": note})
    table = with_paper("sharpness", rows)
    published = paper.table("sharpness").set_index("method")["tenengrad"]
    table.loc[table["source"] == "paper", "ratio"] = [np.nan, published["w/ HR-Net"] / published["w/o HR-Net"]]
    return _mark_closest(table, published)


def _mark_closest(table: pd.DataFrame, published: pd.Series) -> pd.DataFrame:
    """Say which settings come nearest to the paper's ratio, and to its two numbers (as logarithms)."""
    duals = table.index[(table["source"] == "measured") & (table["method"] == ROWS["dual"])]
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = np.abs(np.log(table.loc[duals, "ratio"] / (published["w/ HR-Net"] / published["w/o HR-Net"])))
        numbers = [np.log(table.loc[duals - k, "tenengrad"].to_numpy() / published[m]) for k, m in ((0, "w/ HR-Net"), (1, "w/o HR-Net"))]
    both = pd.Series(np.hypot(*numbers), duals)
    table["closest"] = ""
    for distance, name in ((ratio, "ratio"), (both, "numbers")):
        finite = distance[np.isfinite(distance)]
        if len(finite):
            place = finite.idxmin()
            table.loc[[place - 1, place], "closest"] = table.loc[[place - 1, place], "closest"].where(lambda c: c == "", "ratio, ") + name
    return table


BOUNDARY_COLUMNS = ("f1", "lateral_precision", "lateral_recall", "lateral_f1")


def score_boundaries(run: Run, variant: str, seed: int) -> pd.DataFrame:
    """Boundary scores of each scored image against exact dense depth; the sky counts as the farthest depth."""
    predicted, farthest, rows = Predictions(run, variant, seed), run.profile.evaluation.max_depth, {}
    for image in predicted.scores.index:
        exact = dense_truth(run, image)
        exact = np.where(exact > 0, np.minimum(exact, farthest), farthest)
        rows[image] = boundary_scores(predicted.depth(image, exact.shape), exact)
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("image")


def score_poles(run: Run, variant: str, seed: int) -> pd.DataFrame:
    """Depth metrics of the pixels of poles in each scored image that has some, against exact dense depth."""
    predicted, rows = Predictions(run, variant, seed), {}
    for image in predicted.scores.index:
        exact, labels = dense_truth(run, image), label_map(run, image)
        depth = predicted.depth(image, exact.shape)
        found = class_errors(depth, exact, labels, [POLE], max_depth=run.profile.evaluation.max_depth)
        if found:
            rows[image] = found
    return pd.DataFrame.from_dict(rows, orient="index").rename_axis("image")


def detail_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """Boundaries and poles of each network against exact depth; empty, with the reason, where there is none (real KITTI)."""
    rows = []
    for variant in ("lr", "dual_no_sa", "dual"):
        method = run.profile.variant(variant).label
        if not run.profile.world:
            note = "not run: needs exact dense depth, which the laser does not give"
            rows.append({"method": method, "source": "measured", "note": note})
            continue
        row = training_row(run, variant, seeds, scores=score_boundaries, columns=BOUNDARY_COLUMNS)
        poles = training_row(run, variant, seeds, scores=score_poles, columns=("abs_rel", "a1"))
        renamed = {f"pole_{k}": poles[k] for k in ("abs_rel", "abs_rel_std", "a1", "a1_std", "n") if k in poles}
        rows.append({"method": method, **row, **renamed})
    return pd.DataFrame(rows).rename(columns={c: f"boundary_{c}" for c in (*BOUNDARY_COLUMNS, *(f"{c}_std" for c in BOUNDARY_COLUMNS))})


def detail_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The dual network against LR-Net at boundaries and on poles, paired; nothing where there is no exact depth."""
    if not run.profile.world:
        return pd.DataFrame()
    pairs = [("dual", "lr"), ("dual_no_sa", "lr"), ("dual", "dual_no_sa")]
    boundaries = compare_trainings(run, pairs, seeds, metrics=("f1", "lateral_f1"), scores=score_boundaries).assign(of="boundaries")
    poles = compare_trainings(run, pairs, seeds, scores=score_poles).assign(of="poles")
    return pd.concat([boundaries, poles], ignore_index=True)
