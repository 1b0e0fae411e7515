"""Rows of tables: means over images and seeds beside the paper's rows, and paired comparisons of two methods."""

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
import pandas as pd

from dualdepth import paper
from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.leaks import check_leak
from dualdepth.evaluation.statistics import Comparison, compare
from dualdepth.tables.claims import HIGHER_IS_BETTER, NOT_RUN, Claim, claims_of
from dualdepth.tables.scores import SEEDLESS, Scores

MEASURED = "measured"  # In the column `source`, beside `paper` and NOT_RUN.
COMPARISON = ["of", "a", "b", "metric", *Comparison._fields, "n", "better", "in_words", "reason"]
"""Columns of a table of comparisons: `of` says which images or which part of them, `better` is `lower` or `higher` by the metric, `reason`
says why nothing was compared."""


def over_seeds(frame: pd.DataFrame, metrics: Iterable[str] = METRICS) -> dict[str, Any]:
    """Means over images, then over seeds, of rows (seed, image); `<metric>_std` is the sample standard deviation over seeds, empty for one
    seed, `n` the number of images."""
    of_seed = frame.groupby(level="seed")[list(metrics)].mean()
    row = {f"{metric}{end}": value for metric in of_seed for end, value in (("", of_seed[metric].mean()), ("_std", of_seed[metric].std()))}
    return row | {"n": frame.groupby(level="seed").size().min()}


def not_run(reason: str) -> dict[str, Any]:
    """What a row says that has no numbers."""
    return {"source": NOT_RUN, "reason": reason}


def method_row(scores: Scores, method: str, metrics: Iterable[str] = METRICS, part: str | None = None, note: str = "") -> dict[str, Any]:
    """Row of a training, or of another method: means over its seeds, what it is (with `note` behind it), a leak; or why there is none.
    Column `variant` names trainings alone."""
    trainings = scores.trainings.get(method)
    variant = {"variant": method} if trainings or method not in scores.notes else {}
    if method in scores.missing:
        return variant | not_run(scores.missing[method])
    frame = scores.of(method, part)
    said = {"note": ", ".join(filter(None, [trainings[0].describe() if trainings else scores.notes[method], note]))}
    said["leak"] = check_leak(trainings[0].card, scores.drives, allow=True) if trainings else ""
    return variant | over_seeds(frame, metrics) | {"seeds": seed_label(frame.index.unique("seed")), "source": MEASURED} | said


def seed_label(seeds: Iterable[int]) -> str:
    """Seeds as a table has them."""
    return " ".join(str(seed) for seed in seeds if seed != SEEDLESS)


def with_paper(name: str, rows: Sequence[dict[str, Any]]) -> pd.DataFrame:
    """The paper's table and our rows below it; counts are whole numbers, words that are missing are empty."""
    table = pd.concat([paper.table(name), pd.DataFrame(list(rows))], ignore_index=True)
    words = ("seeds", "note", "reason", "leak")
    table = table.reindex(columns=[*(c for c in table if c not in words), *words])
    if "n" in table:
        table["n"] = table["n"].astype("Int64")
    return _with_words(table, words)


def paired(
    scores: Scores, a: str, b: str, metrics: Iterable[str] = ("abs_rel", "a1"), *, part: str | None = None, block: int = 1, of: str = ""
) -> list[dict[str, Any]]:
    """Rows of `COMPARISON`: two methods over the images that both have, image by image and seed by seed; `a` is claimed to be better.

    A method that knows no seed stands against every seed of the other. For `block` see `compare`.
    """
    place = {"of": of or part or "", "a": a, "b": b}
    if reason := _why_not(scores, a, b):
        return [place | {"metric": "", "reason": reason}]
    rows = []
    for metric in metrics:
        of_a, of_b = (scores.of(method, part)[metric].unstack("seed").dropna() for method in (a, b))
        shared = of_a.index.intersection(of_b.index)
        values = np.broadcast_arrays(of_a.loc[shared].to_numpy().T, of_b.loc[shared].to_numpy().T)
        rows.append(place | {"metric": metric} | compared(*values, lower_is_better=metric not in HIGHER_IS_BETTER, block=block))
    return rows


def gains(scores: Scores, pair: tuple[str, str], parts: Sequence[str], *, relative: bool = False) -> list[dict[str, Any]]:
    """Is the gain in Abs Rel of a over b, of `pair` = (a, b), larger in the first part than in the second, in the images that have both?

    Relative gains are in units of b's mean error in the part. A row of `COMPARISON`; none where the pair cannot be compared.
    """
    if _why_not(scores, *pair):
        return []
    found = []
    for part in parts:
        after, before = (scores.of(method, part)["abs_rel"].unstack("seed") for method in pair)
        found.append((before - after).dropna() / (before.mean() if relative else 1.0))
    shared = found[0].index.intersection(found[1].index)
    first, second = (gain.loc[shared].to_numpy().T for gain in found)
    name = "relative gain" if relative else "gain"
    a, b = (f"{name} of {pair[0]}, {part}" for part in parts)
    return [{"of": " against ".join(parts), "a": a, "b": b, "metric": "abs_rel"} | compared(first, second, lower_is_better=False)]


def compared(a: np.ndarray, b: np.ndarray, *, lower_is_better: bool, block: int = 1) -> dict[str, Any]:
    """Means, difference, intervals and words for values (S seeds, N images) of two methods."""
    images = np.shape(a)[1]
    row = {"n": images, "better": "lower" if lower_is_better else "higher"}
    if images < 2 * block:
        return row | {"reason": f"{images} snippets, too few for runs of {block}" if block > 1 else f"{images} image{'s' * (images != 1)}"}
    result = compare(a, b, block=block)
    return row | {**result._asdict(), "in_words": in_words(result, lower_is_better)}


def comparisons(rows: Iterable[dict[str, Any]], *more: str) -> pd.DataFrame:
    """The table of comparisons; `more` columns stand behind `of`."""
    table = pd.DataFrame(list(rows), columns=[COMPARISON[0], *more, *COMPARISON[1:]])
    return _with_words(table, ["of", *more, "metric", "better", "in_words", "reason"])


def claims_table(scores: Scores, table: str) -> pd.DataFrame:
    """The pairs that the paper's claims about a table of whole images name, such as `ablation`, compared with the better one first."""
    return comparisons(row for claim in claims_of(table) for row in paired(scores, *_pair(claim, scores)))


def _pair(claim: Claim, scores: Scores) -> tuple[str, str]:
    """The two that a claim compares, or those that stand for them."""
    begun = [scores.trainings[method][0].card["pretrained"] if method in scores.trainings else None for method in (claim.a, claim.b)]
    alike = None not in begun and begun[0] == begun[1]
    return (claim.a, claim.b) if alike or not claim.instead or scores.missing.keys() & set(claim.instead) else claim.instead


def _with_words(table: pd.DataFrame, columns: Sequence[str]) -> pd.DataFrame:
    """The table with empty text where one of these columns has nothing."""
    return table.astype(dict.fromkeys(columns, object)).fillna(dict.fromkeys(columns, ""))


def _why_not(scores: Scores, a: str, b: str) -> str:
    """Why two methods cannot be compared; nothing if they can. Trainings of one stage after the same must be equally long."""
    reasons = dict.fromkeys(scores.missing[method] for method in (a, b) if method in scores.missing)
    pairs = zip(scores.trainings.get(a, []), scores.trainings.get(b, []))
    alike = [(x.card, y.card) for x, y in pairs if not reasons and x.stage == y.stage]
    lengths = [(x["steps"], y["steps"]) for x, y in alike if bool(x["starts_from"]) == bool(y["starts_from"])]
    unequal = [f"{a} was trained for {x} steps, {b} for {y}" for x, y in lengths if x != y]
    return "; ".join([*reasons, *unequal[:1]])


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


def readable(table: pd.DataFrame, digits: int = 3) -> pd.DataFrame:
    """The table for the eye: a column with a spread over seeds as "mean ± spread", no columns that are empty or only for programs."""
    shown, means = table.copy(), [c for c in table if f"{c}_std" in table]
    for column in (c for c in means if pd.api.types.is_numeric_dtype(table[c])):
        pairs = zip(table[column], table[f"{column}_std"])
        said = [f"{mean:.{digits}f}" + ("" if pd.isna(std) else f" ± {std:.{digits}f}") for mean, std in pairs]
        shown[column] = ["" if pd.isna(mean) else words for mean, words in zip(table[column], said)]
    empty = [c for c in shown if shown[c].isna().all() or (shown[c].astype(str) == "").all()]
    hidden = {"variant", "device", *empty, *(f"{c}_std" for c in means)}
    last = ("seeds", "source", "note", "reason", "leak")
    return shown[[c for c in shown if c not in (*hidden, *last)] + [c for c in last if c in shown and c not in hidden]]


def show(table: pd.DataFrame, digits: int = 3) -> None:
    """Show a table in a notebook, what was measured in bold type."""
    from IPython.display import display

    styled = readable(table, digits).style.format(precision=digits, na_rep="").hide(axis="index")
    display(styled.apply(lambda row: ["font-weight: bold" if row.get("source") == MEASURED else ""] * len(row), axis=1))


def tell(comparisons: pd.DataFrame) -> None:
    """Print a table of comparisons, a line each."""
    for row in comparisons.itertuples():
        place = " ".join(filter(None, [row.of, f"seed {row.seed}" if getattr(row, "seed", "") else ""]))
        said = row.in_words if not row.reason else f"not compared: {row.reason}"
        print(f"{place + ': ' * bool(place)}{row.a} against {row.b}{', ' * bool(row.metric)}{row.metric}: {said}")
