"""Sharpness: the paper's Tenengrad in every reading of it, and measures that blur cannot please."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import pandas as pd

from dualdepth import paper
from dualdepth.evaluation.depth import METRICS, resize_bilinear
from dualdepth.evaluation.parts import pole_errors
from dualdepth.evaluation.sharpness import boundary_scores, tenengrad
from dualdepth.run import Run
from dualdepth.tables.rows import MEASURED, comparisons, method_row, not_run, over_seeds, paired, with_paper
from dualdepth.tables.scores import NO_TRUTH, Scores, Trained, collect, scored

METHODS = {"lr": "w/o HR-Net", "dual": "w/ HR-Net"}
DETAILED = ("lr", "dual_no_sa", "dual")
THRESHOLDS = {"depth, m": (0, 2, 5, 10, 20, 50, 100), "inverse depth / its mean": (0, 0.1, 0.25, 0.5, 1, 2, 4)}
"""t of the sweep, in the unit of the map; a Sobel filter's answer is eight times the step from pixel to pixel."""
SIZES = ("native", "common")  # Each map at its own size, or all at HR-Net's.
READING = ["map", "size", "threshold"]
BOUNDARY_COLUMNS = ("f1", "lateral_precision", "lateral_recall", "lateral_f1")
NO_DENSE_TRUTH = "needs exact dense depth, which the laser does not give"


def readings(training: Trained, image: int) -> dict[tuple[str, str, float], float]:
    """Tenengrad of a scored frame's predicted depth in every reading (map, size, threshold)."""
    disparity, found = np.asarray(training.disparities[image]), {}
    for size in SIZES:
        shape = disparity.shape if size == "native" else training.run.profile.data.hr_size
        inverse = resize_bilinear(disparity, shape)
        maps = {"depth, m": training.depth(image, shape), "inverse depth / its mean": inverse / inverse.mean()}
        for kind, values in maps.items():
            found |= {(kind, size, t): total for t, total in zip(THRESHOLDS[kind], tenengrad(values, THRESHOLDS[kind]))}
    return found


def tenengrad_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """Tenengrad of every scored frame, without and with HR-Net; a column for each reading."""
    return collect(run, METHODS, seeds, lambda t: _by_image({image: readings(t, image) for image in t.scores.index}))


def sharpness_table(scores: Scores) -> pd.DataFrame:
    """The paper's two rows, and ours for each map, size and threshold: mean Tenengrad and the ratio w/ over w/o HR-Net.

    Means and standard deviations are over seeds. `closest` marks the reading whose ratio is nearest to the paper's; the numbers
    themselves cannot be compared (docs/protocols.md, "Sharpness").
    """
    published = paper.table("sharpness").set_index("method")["tenengrad"]
    paper_ratio = published["w/ HR-Net"] / published["w/o HR-Net"]
    if scores.missing:
        rows = [{"method": method, **not_run("; ".join(dict.fromkeys(scores.missing.values())))} for method in METHODS.values()]
    else:
        rows = _measured_rows(scores)
    table = with_paper("sharpness", rows)
    table = table.reindex(columns=list(dict.fromkeys([*table, *READING, "tenengrad_std", "ratio", "ratio_std", "n"])))
    table.loc[table["source"] == "paper", "ratio"] = [np.nan, paper_ratio]
    ours = table.loc[(table["source"] == MEASURED) & (table["ratio"] > 0), "ratio"]
    table["closest"] = table.index.isin([np.abs(np.log(ours / paper_ratio)).idxmin()] if len(ours) else [])
    return table


def _measured_rows(scores: Scores) -> list[dict[str, Any]]:
    of_seeds = {variant: scores.of(variant).groupby(level="seed").mean() for variant in METHODS}
    ratios = of_seeds["dual"] / of_seeds["lr"].where(of_seeds["lr"] > 0)
    rows = []
    for kind, thresholds in THRESHOLDS.items():
        for reading in [(kind, size, t) for size in SIZES for t in thresholds]:
            for variant, method in METHODS.items():
                totals = of_seeds[variant][reading]
                row = {"method": method, **dict(zip(READING, reading)), "tenengrad": totals.mean(), "tenengrad_std": totals.std()}
                if variant == "dual":
                    row |= {"ratio": ratios[reading].mean(), "ratio_std": ratios[reading].std()}
                rows.append(row | method_row(scores, variant, ()))
    return rows


def detail_scores(run: Run, seeds: Sequence[int]) -> tuple[Scores, Scores]:
    """Boundary scores of each scored frame against exact dense depth, and depth metrics of the pixels of poles in each that has some."""
    frames, farthest = scored(run), run.profile.evaluation.max_depth
    reason = "" if run.profile.world else NO_DENSE_TRUTH if run.profile.data.has_truth else NO_TRUTH

    def boundaries(training: Trained) -> pd.DataFrame:
        exact = {image: below_sky(run, image) for image in training.scores.index}
        return _by_image({image: boundary_scores(training.depth(image, e.shape), e) for image, e in exact.items()})

    def poles(training: Trained) -> pd.DataFrame:
        found = {}
        for image in training.scores.index:
            exact, labels = frames.exact_depth(image), frames.label_map(image)
            found[image] = pole_errors(training.depth(image, exact.shape), exact, labels, max_depth=farthest)
        return _by_image({image: errors for image, errors in found.items() if errors}, [*METRICS, "valid_pixels"])

    return collect(run, DETAILED, seeds, boundaries, reason=reason), collect(run, DETAILED, seeds, poles, reason=reason)


def below_sky(run: Run, image: int) -> np.ndarray:
    """Exact depth (H, W) of a scored frame; the sky counts as the farthest depth."""
    exact, farthest = scored(run).exact_depth(image), run.profile.evaluation.max_depth
    return np.where(exact > 0, np.minimum(exact, farthest), farthest)


def detail_table(run: Run, boundaries: Scores, poles: Scores) -> pd.DataFrame:
    """Boundaries and poles of each network against exact depth, and what its size could reach; rows say why where there is none."""
    rows = []
    for variant in DETAILED:
        row = {"method": run.profile.variant(variant).label, **method_row(boundaries, variant, BOUNDARY_COLUMNS)}
        of_poles = method_row(poles, variant, ("abs_rel", "a1"))
        rows.append(row | {f"pole_{k}": of_poles[k] for k in ("abs_rel", "abs_rel_std", "a1", "a1_std", "n") if k in of_poles})
    sizes = (run.profile.data.lr_size, run.profile.data.hr_size)
    for size in sizes if run.profile.world else ():
        reached = {}  # by exact depth itself, shrunk to a network's size and enlarged again
        for image in range(len(scored(run).frames)):
            exact = below_sky(run, image)
            shrunk = 1 / cv2.resize(1 / exact, size[::-1], interpolation=cv2.INTER_AREA)
            reached[image] = boundary_scores(resize_bilinear(shrunk, exact.shape), exact)
        values = over_seeds(pd.concat({0: _by_image(reached)}, names=["seed"]), BOUNDARY_COLUMNS)
        note = "no network: exact depth shrunk to this size, so the best that it could reach"
        rows.append({"method": f"exact depth at {size[0]}x{size[1]}", **values, "source": MEASURED, "note": note})
    renamed = {f"{c}{end}": f"boundary_{c}{end}" for c in BOUNDARY_COLUMNS for end in ("", "_std")}
    columns = ["method", "variant", *renamed.values(), "n", "pole_abs_rel", "pole_abs_rel_std", "pole_a1", "pole_a1_std", "pole_n"]
    return pd.DataFrame(rows).rename(columns=renamed).reindex(columns=[*columns, "seeds", "source", "note", "reason", "leak"])


def detail_claims(boundaries: Scores, poles: Scores) -> pd.DataFrame:
    """The networks against each other at boundaries and on poles, paired."""
    pairs = [("dual", "lr"), ("dual_no_sa", "lr"), ("dual", "dual_no_sa")]
    rows = [row for pair in pairs for row in paired(boundaries, *pair, ("f1", "lateral_f1"), of="boundaries")]
    return comparisons(rows + [row for pair in pairs for row in paired(poles, *pair, of="poles")])


def _by_image(rows: dict[int, dict[Any, float]], columns: Sequence[str] | None = None) -> pd.DataFrame:
    return pd.DataFrame.from_dict(rows, orient="index", columns=columns).rename_axis("image")
