"""What all tables share: a training's row over its seeds, why a row is empty, and how two trainings compare."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dualdepth import paper
from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.leaks import check_leak
from dualdepth.evaluation.statistics import Comparison, compare, mean_std
from dualdepth.run import Run
from dualdepth.tables.scoring import score_training, scored_drives, scored_note
from dualdepth.training.weights import load_card

Scores = Callable[..., pd.DataFrame]
"""Of (run, variant, seed): per-image values of a training, such as `score_training`."""


def mean_row(frames: Sequence[pd.DataFrame], columns: Sequence[str] = METRICS) -> dict[str, Any]:
    """Means over images, then over seeds; `<column>_std` is the standard deviation over seeds, empty for one; `n` images."""
    row: dict[str, Any] = {}
    for column in columns:
        row[column], row[f"{column}_std"] = mean_std([frame[column].mean() if len(frame) else np.nan for frame in frames])
    return row | {"n": min(len(frame) for frame in frames)}


NO_TRUTH = "not run: an own camera has no ground truth"


def training_row(
    run: Run,
    variant: str,
    seeds: Sequence[int],
    *,
    scores: Scores = score_training,
    columns: Sequence[str] = METRICS,
    own_truth: bool = False,
) -> dict[str, Any]:
    """Measured row of a variant over its seeds; one that the profile does not train or cannot score has no numbers and says so.

    `own_truth`: the scores are of another benchmark, which brings its ground truth.
    """
    if not (own_truth or run.profile.data.has_truth):
        return {"variant": variant, "n": np.nan, "seeds": "", "source": "measured", "note": NO_TRUTH}
    if variant not in run.profile.train:
        return {"variant": variant, "source": "measured", "note": f"not run: profile {run.profile.name} does not train it"}
    values = mean_row([scores(run, variant, seed) for seed in seeds], columns)
    return {"variant": variant, **values, "seeds": seed_label(seeds), "source": "measured", "note": training_note(run, variant, seeds[0])}


def seed_label(seeds: Sequence[int]) -> str:
    """Seeds as a table has them."""
    return " ".join(map(str, seeds))


def training_note(run: Run, variant: str, seed: int, *, drives: Sequence[str] | None = None) -> str:
    """What a row's training was, from its card: backbone, size, weights it began with, steps; an incomplete test list; a leak.

    `drives` are those of the frames that are scored, where they are not the depth tables' frames.
    """
    card, chosen = load_card(run.weights(variant, seed)), run.profile.variant(variant)
    height, width = run.profile.data.lr_size if chosen.network == "lr" else run.profile.data.hr_size
    before = f" after {card['starts_from']['steps']} of stage 1" if card["starts_from"] else ""
    parts = [card["encoder"]] if chosen.network != "hr" else []
    parts += [f"{height}x{width}", "ImageNet weights" if card["pretrained"] else "no ImageNet weights", f"{card['steps']} steps{before}"]
    incomplete = scored_note(run) if drives is None else ""
    leak = check_leak(card, scored_drives(run) if drives is None else drives, allow=True)
    return ", ".join([*parts, "last epoch", *filter(None, [incomplete, leak])])


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
    own_truth: bool = False,
) -> pd.DataFrame:
    """Paired differences between variants, image by image and seed by seed.

    Of each pair (a, b), a is the one that the paper says is better; for `own_truth` see `training_row`.

    Returns:
        Rows per pair and metric: both means, the difference a − b, its 95 % interval over images, its spread over seeds, and in words
        whether a is better, judged by both. A pair that cannot be compared has words alone.
    """
    rows = []
    for a, b in pairs:
        reason = _why_not(run, a, b, seeds) if own_truth or run.profile.data.has_truth else NO_TRUTH
        if reason:
            rows.append({"a": a, "b": b, "metric": "", "in_words": reason})
            continue
        frames = [[scores(run, variant, seed) for seed in seeds] for variant in (a, b)]
        shared = frames[0][0].index
        for frame in (*frames[0], *frames[1]):
            shared = shared.intersection(frame.index)
        for metric in metrics:
            values = [[frame.loc[shared, metric].to_numpy() for frame in method] for method in frames]
            rows.append({"a": a, "b": b, "metric": metric} | comparison_row(*values, lower_is_better=metric in LOWER_IS_BETTER))
    return pd.DataFrame(rows, columns=COMPARISON)


def compare_gains(
    run: Run, pair: tuple[str, str], parts: Sequence[str], seeds: Sequence[int], *, scores: Scores, relative: bool = False
) -> dict[str, Any]:
    """Is the gain in Abs Rel of a over b, of `pair` = (a, b), larger in the first part than in the second, in the images that have both?

    `scores` takes `part`. Relative gains are in units of b's mean error in the part.
    """
    gains = []
    for part in parts:
        after, before = ([scores(run, variant, seed, part=part)["abs_rel"] for seed in seeds] for variant in pair)
        gains.append([(b - a) / (b.mean() if relative else 1.0) for a, b in zip(after, before)])
    shared = gains[0][0].index.intersection(gains[1][0].index)
    first, second = ([gain.loc[shared].to_numpy() for gain in part] for part in gains)
    return {"metric": "abs_rel"} | comparison_row(first, second, lower_is_better=False)


def _why_not(run: Run, a: str, b: str, seeds: Sequence[int]) -> str:
    """Why two variants cannot be compared; nothing if they can."""
    missing = [v for v in (a, b) if v not in run.profile.train]
    if missing:
        return f"not run: profile {run.profile.name} does not train {' nor '.join(missing)}"
    if run.profile.variant(a).stage == run.profile.variant(b).stage:
        for seed in seeds:
            of_a, of_b = (load_card(run.weights(variant, seed))["steps"] for variant in (a, b))
            if of_a != of_b:
                return f"not compared: {a} was trained for {of_a} steps, {b} for {of_b}"
    return ""


COMPARISON = ["a", "b", "metric", *Comparison._fields, "n", "in_words"]
"""Columns of a table of comparisons."""


def comparison_row(a: Sequence[np.ndarray], b: Sequence[np.ndarray], *, lower_is_better: bool, block: int = 1) -> dict[str, Any]:
    """Means, difference, intervals and words for per-image values (S, N) of two methods; for `block` see `paired_bootstrap`."""
    images = len(a[0])
    if images < 2:
        return {"n": images, "in_words": f"not compared: {images} {'image' if images == 1 else 'images'}"}
    result = compare(a, b, block=block)
    return {**result._asdict(), "n": images, "in_words": in_words(result, lower_is_better)}


LOWER_IS_BETTER = ("abs_rel", "sq_rel", "rmse", "rmse_log")


def in_words(result: Comparison, lower_is_better: bool) -> str:
    """Whether a is better than b, and whether that could be chance: by the images that happen to be scored, by the seed."""
    if not result.difference:
        return "the same"
    better = (result.difference < 0) == lower_is_better
    images = "excludes" if result.clear_of_images else "includes"
    words = f"{'better' if better else 'worse'} by {abs(result.difference):.2g}: the interval over images {images} 0, "
    if result.clear_of_seeds is None:
        return words + "one seed"
    return words + f"that over {result.seeds} seeds {'excludes' if result.clear_of_seeds else 'includes'} 0"


def readable(table: pd.DataFrame, columns: Sequence[str], digits: int = 3) -> pd.DataFrame:
    """The table for the eye: `columns` as "mean ± standard deviation over seeds", or the mean alone; empty where there is none."""
    shown = table.copy()
    for column in columns:
        spread = table.get(f"{column}_std", pd.Series(np.nan, table.index))
        shown[column] = [
            "" if pd.isna(mean) else f"{mean:.{digits}f}" + ("" if pd.isna(std) else f" ± {std:.{digits}f}")
            for mean, std in zip(table[column], spread)
        ]
    return shown.drop(columns=[c for c in shown if c.endswith("_std")])
