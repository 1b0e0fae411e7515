"""What all tables share: a training's row over its seeds, why a row is empty, and how two trainings compare."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dualdepth import paper
from dualdepth.checkpoints import load_card
from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.statistics import Comparison, compare, mean_std
from dualdepth.results import Run
from dualdepth.scoring import score_training, scored_note

Scores = Callable[[Run, str, int], pd.DataFrame]
"""Per-image values of a variant's training with a seed, such as `score_training`."""


def mean_row(frames: Sequence[pd.DataFrame], columns: Sequence[str] = METRICS) -> dict[str, Any]:
    """Means over images, then over seeds; `<column>_std` is the standard deviation over seeds, empty for one; `n` images."""
    row: dict[str, Any] = {}
    for column in columns:
        row[column], row[f"{column}_std"] = mean_std([frame[column].mean() for frame in frames])
    return row | {"n": min(len(frame) for frame in frames)}


def training_row(
    run: Run, variant: str, seeds: Sequence[int], *, scores: Scores = score_training, columns: Sequence[str] = METRICS
) -> dict[str, Any]:
    """Measured row of a variant over its seeds; one that the profile does not train has no numbers and says so."""
    if variant not in run.profile.train:
        return {"variant": variant, "source": "measured", "note": f"not run: profile {run.profile.name} does not train it"}
    values = mean_row([scores(run, variant, seed) for seed in seeds], columns)
    note = f"{training_note(run, variant)}, {steps(run, variant, seeds[0])} steps"
    return {"variant": variant, **values, "seeds": said_seeds(seeds), "source": "measured", "note": note}


def steps(run: Run, variant: str, seed: int) -> int:
    """Optimiser steps of a training, from its card."""
    return int(load_card(run.weights(variant, seed))["steps"])


def said_seeds(seeds: Sequence[int]) -> str:
    """Seeds as a table has them."""
    return " ".join(map(str, seeds))


def training_note(run: Run, variant: str) -> str:
    """Backbone, size, weights it began with, and whether the test list is incomplete."""
    chosen, training = run.profile.variant(variant), run.profile.of_variant(variant).training
    height, width = run.profile.data.lr_size if chosen.network == "lr" else run.profile.data.hr_size
    weights = "ImageNet weights" if training.pretrained and chosen.network != "hr" else "no ImageNet weights"
    parts = [f"{height}x{width}", weights, "last epoch", scored_note(run)]
    return ", ".join(filter(None, [training.encoder if chosen.network != "hr" else "", *parts]))


def with_paper(name: str, rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """The paper's table and our rows below it; counts are whole numbers, an empty note is empty."""
    table = pd.concat([paper.table(name), pd.DataFrame(list(rows))], ignore_index=True)
    if "n" in table:
        table["n"] = table["n"].astype("Int64")
    return table.fillna({"note": "", "seeds": ""})


def compare_trainings(
    run: Run,
    pairs: Sequence[tuple[str, str]],
    seeds: Sequence[int],
    *,
    metrics: Sequence[str] = ("abs_rel", "a1"),
    scores: Scores = score_training,
) -> pd.DataFrame:
    """Paired differences between variants, image by image and seed by seed.

    Args:
        run: of the profile.
        pairs: (a, b), of which a is the one that the paper says is better.
        seeds: trained of both.
        metrics: columns of the scores.
        scores: gives them.

    Returns:
        Rows per pair and metric: both means, the difference a − b, its 95 % interval over images, its spread over seeds, and in words
        whether a is better outside both. A pair that was not trained, or not equally long in the same stage, has words alone.
    """
    rows = []
    for a, b in pairs:
        missing = [v for v in (a, b) if v not in run.profile.train]
        if missing:
            rows.append(
                {"a": a, "b": b, "metric": "", "in_words": f"not run: profile {run.profile.name} does not train {' nor '.join(missing)}"}
            )
            continue
        if run.profile.variant(a).stage == run.profile.variant(b).stage:
            taken = [steps(run, variant, seeds[0]) for variant in (a, b)]
            if taken[0] != taken[1]:
                rows.append(
                    {"a": a, "b": b, "metric": "", "in_words": f"not compared: {a} was trained for {taken[0]} steps, {b} for {taken[1]}"}
                )
                continue
        frames = [[scores(run, variant, seed) for seed in seeds] for variant in (a, b)]
        shared = frames[0][0].index
        for frame in (*frames[0], *frames[1]):
            shared = shared.intersection(frame.index)
        for metric in metrics:
            result = compare(*([frame.loc[shared, metric].to_numpy() for frame in method] for method in frames))
            words = in_words(result, metric)
            rows.append({"a": a, "b": b, "metric": metric, **result._asdict(), "n": len(shared), "in_words": words})
    return pd.DataFrame(rows, columns=["a", "b", "metric", *Comparison._fields, "n", "in_words"])


LOWER_IS_BETTER = ("abs_rel", "sq_rel", "rmse", "rmse_log")


def in_words(result: Comparison, metric: str) -> str:
    """Whether a is better than b, and what that stands outside of."""
    better = result.difference < 0 if metric in LOWER_IS_BETTER else result.difference > 0
    direction = "better" if better else "worse" if result.difference else "the same"
    images = "outside the interval over images" if result.clear_of_images else "inside the interval over images"
    if result.clear_of_seeds is None:
        seeds = "one seed, no spread known"
    else:
        seeds = f"{'outside' if result.clear_of_seeds else 'inside'} the spread over {result.seeds} seeds"
    return f"{direction} by {np.abs(result.difference):.3f}: {images}, {seeds}"
