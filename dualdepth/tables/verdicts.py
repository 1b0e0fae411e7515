"""Which of the paper's numbers and claims hold: ours beside the paper's, and the rules of judgement."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from dualdepth.evaluation.statistics import t_interval
from dualdepth.paper import DEPTH

REPRODUCED, WITHIN_NOISE, NOT_REPRODUCED, NOT_RUN = "reproduced", "within noise", "not reproduced", "not run"
TOLERANCE = 0.02
"""Share of the paper's number within which ours counts as the same; half of the last printed digit counts, too."""

RULES = {
    "A number": f"reproduced: at most {TOLERANCE:.0%} (or half of the last printed digit) from the paper's, or better. Within noise:"
    " farther off, but the paper's number lies in our 95 % interval over at least two seeds. Not reproduced: else.",
    "A claim": "reproduced: our difference has the claimed sign, and its 95 % intervals over images and, with two seeds or more, over"
    " seeds exclude zero. Within noise: one of them includes zero. Not reproduced: the opposite sign, as surely.",
    "Either": "not run: there is no number of ours; the reason is said.",
}
"""In words what `judge_number` and `judge_claim` do."""


class Verdict(NamedTuple):
    """One of the four words, and what a reader must know beside it."""

    word: str
    why: str = ""

    def columns(self) -> dict[str, str]:
        """`verdict`, for what was not run with its reason, and `note`."""
        if self.word == NOT_RUN:
            return {"verdict": f"{self.word}: {self.why}", "note": ""}
        return {"verdict": self.word, "note": self.why}


def judge_number(paper: float, ours: float, *, spread: float, seeds: int, digit: float, lower_is_better: bool | None) -> Verdict:
    """Whether a number of the paper is reproduced (`RULES`).

    Args:
        paper, ours: the paper's, and our mean over seeds.
        spread, seeds: our standard deviation over seeds, NaN for one, and how many there are.
        digit: the last digit that the paper prints, such as 0.001.
        lower_is_better: None where neither is, as for a parameter count.
    """
    if np.isnan(ours):
        return Verdict(NOT_RUN)
    difference = ours - paper
    if abs(difference) <= max(TOLERANCE * abs(paper), digit / 2) * (1 + 1e-9):
        return Verdict(REPRODUCED)
    if lower_is_better is not None and (difference < 0) == lower_is_better:
        return Verdict(REPRODUCED, "better than the paper's")
    if seeds > 1 and abs(difference) <= t_interval(spread, seeds):
        return Verdict(WITHIN_NOISE)
    return Verdict(NOT_REPRODUCED)


def judge_claim(difference: float, low: float, high: float, *, spread: float, seeds: int, lower_is_better: bool) -> Verdict:
    """Whether a claim of the paper holds (`RULES`).

    Args:
        difference: mean of the method that is claimed to be better minus the other.
        low, high: ends of its 95 % interval over images.
        spread, seeds: its standard deviation over seeds, NaN for one, and how many there are.
        lower_is_better: of the metric.
    """
    if np.isnan(difference):
        return Verdict(NOT_RUN)
    certain = (low > 0 or high < 0) and (seeds < 2 or abs(difference) > t_interval(spread, seeds))
    one = "" if seeds > 1 else "one seed"
    if not certain:
        return Verdict(WITHIN_NOISE, one)
    return Verdict(REPRODUCED if (difference < 0) == lower_is_better else NOT_REPRODUCED, one)


class Claim(NamedTuple):
    """A claim of the paper and the row of a table of comparisons that tells."""

    text: str
    table: str
    """File name, without suffix, in `results/<profile>/tables`."""
    where: dict[str, str | tuple[str, ...]]
    """Columns and their values, or those that serve."""
    lower_is_better: bool
    needs: tuple[str, dict[str, str], bool] | None = None
    """Table, row and `lower_is_better` of a difference that must hold as well: to gain more is nothing without a gain."""


def _pair(text: str, table: str, a: str, b: str, **more: str) -> list[Claim]:
    return [Claim(text, table, {"a": a, "b": b, "metric": m, **more}, m == "abs_rel") for m in ("abs_rel", "a1")]


CLAIMS = (
    *_pair("The dual network is better than LR-Net", "ablation_claims", "dual", "lr"),
    *_pair("HR-Net without SA-Attention is better than LR-Net", "ablation_claims", "dual_no_sa", "lr"),
    *_pair("SA-Attention adds to it", "ablation_claims", "dual", "dual_no_sa"),
    *_pair("HR-Net is worse without LR-Net's features", "ablation_claims", "dual", "hr_only"),
    *_pair("The feature reconstruction loss helps", "ablation_claims", "lr", "lr_no_feature_loss"),
    *_pair("Augmenting before down-sampling helps", "ablation_claims", "lr", "lr_downsample_first"),
    Claim(
        "The gain is largest far away",
        "distance_claims",
        {"a": "gain of dual, > 20 m", "metric": "abs_rel"},
        False,
        ("distance_claims", {"distance": "> 20 m", "a": "dual", "b": "lr", "metric": "abs_rel"}, True),
    ),
    Claim("Edges of the dual network are sharper", "sharpness_claims", {"of": "boundaries", "a": "dual", "b": "lr", "metric": "f1"}, False),
    Claim("Slim poles are seen", "sharpness_claims", {"of": "poles", "a": "dual", "b": "lr", "metric": "abs_rel"}, True),
    Claim("SA-Attention helps on road", "sa_region_claims", {"region": "Road", "a": "dual", "b": "dual_no_sa", "metric": "abs_rel"}, True),
    Claim(
        "SA-Attention helps more on road than on tree & grass",
        "sa_region_claims",
        {"a": "gain of dual, Road", "metric": "abs_rel"},
        False,
        ("sa_region_claims", {"region": "Road", "a": "dual", "b": "dual_no_sa", "metric": "abs_rel"}, True),
    ),
    *_pair("The dual network is better than ResNet18 at high resolution", "backbone_claims", "dual", "resnet18"),
    *_pair("The dual network is better than MobileNet V2 at high resolution", "backbone_claims", "dual", "mobilenet_v2"),
    *_pair("ImageNet weights help", "backbone_claims", "dual", "dual_scratch"),
    *(
        Claim(
            f"Stage 2 betters the poses of sequence {name}",
            "odometry_claims",
            {"sequence": f"sequence {name}", "a": ("odometry_dual", "dual"), "b": ("odometry_lr", "lr"), "metric": "snippet_ate_3"},
            True,
        )
        for name in ("09", "10")
    ),
)
"""What the paper claims, as far as a difference tells."""


def judge_claims(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Every claim: both means, the difference, its interval over images, its spread over seeds, the verdict.

    `tables` are of comparisons, by file name; one that is missing leaves its claims not run.
    """
    rows = []
    for claim in CLAIMS:
        row: dict[str, Any] = {"claim": claim.text, "metric": claim.where["metric"]}
        found, why = _row(tables.get(claim.table), claim.where), "no comparison was made"
        if found is None:  # one that could not be compared has no metric, and says why
            found = _row(tables.get(claim.table), {k: v for k, v in claim.where.items() if k != "metric"})
            why = why if found is None or pd.notna(found.get("difference")) else str(found["in_words"])
            rows.append(row | Verdict(NOT_RUN, why.removeprefix("not run: ").removeprefix("not compared: ")).columns())
            continue
        numbers = {k: float(found[k]) for k in ("mean_a", "mean_b", "difference", "low", "high", "spread")}
        verdict = _judge_row(found, claim.lower_is_better)
        if claim.needs and verdict.word == REPRODUCED:
            needed = _row(tables.get(claim.needs[0]), claim.needs[1])
            first = Verdict(NOT_RUN, "no comparison was made") if needed is None else _judge_row(needed, claim.needs[2])
            if first.word != REPRODUCED:
                verdict = Verdict(first.word, first.why if first.word == NOT_RUN else "more than the other, but is it a gain at all?")
        rows.append(row | numbers | {"seeds": found["seeds"], "n": found["n"]} | verdict.columns())
    columns = ["claim", "metric", "mean_a", "mean_b", "difference", "low", "high", "spread", "seeds", "n", "verdict", "note"]
    return pd.DataFrame(rows).reindex(columns=columns)


def _judge_row(row: pd.Series, lower_is_better: bool) -> Verdict:
    """`judge_claim` of a row of comparisons."""
    values = [float(row[k]) for k in ("difference", "low", "high")]
    seeds = int(row["seeds"]) if pd.notna(row["seeds"]) else 1
    verdict = judge_claim(*values, spread=float(row["spread"]), seeds=seeds, lower_is_better=lower_is_better)
    return verdict if verdict.word != NOT_RUN else Verdict(NOT_RUN, str(row["in_words"]).removeprefix("not compared: "))


def _row(table: pd.DataFrame | None, where: Mapping[str, str | int | tuple[str, ...]]) -> pd.Series | None:
    """The first row with these values; None where there is none."""
    if table is None or not set(where) <= set(table):
        return None
    serving = {column: value if isinstance(value, tuple) else (value,) for column, value in where.items()}
    mask = np.logical_and.reduce([table[column].isin(v) | table[column].astype(str).isin(v) for column, v in serving.items()])
    return table[mask].iloc[0] if mask.any() else None


class PaperRow(NamedTuple):
    """A row of the paper and ours that is to be like it."""

    table: str
    paper: dict[str, str]
    ours: dict[str, str | int | tuple[str, ...]]
    metrics: Sequence[str] = DEPTH


_OVERHEAD = ("params_m", "gmacs", "abs_rel", "sq_rel", "rmse", "a1", "a2", "a3")
_ONE_RATIO = {"scaling": "one median ratio an image"}
PAIRS = (
    PaperRow("main", {"method": "Train set mean"}, {"method": "Train set mean"}),
    PaperRow("main", {"method": "Ours"}, {"method": "LR-Net + HR-Net, w/ SA"}),
    PaperRow("make3d", {"method": "Ours"}, {"variant": "dual", "convention": "band"}, ("abs_rel", "sq_rel", "rmse")),
    PaperRow("ablation", {"method": "Baseline (LR-Net only)"}, {"variant": "lr"}),
    PaperRow("ablation", {"method": "LR-Net+HR-Net (w/o SA module)"}, {"variant": "dual_no_sa"}),
    PaperRow("ablation", {"method": "LR-Net+HR-Net (w/ SA module)"}, {"variant": "dual"}),
    *(
        PaperRow("distance", {"method": method, "distance": part}, {"variant": variant, "distance": part} | _ONE_RATIO)
        for method, variant in (("w/o HR-Net", "lr"), ("w/ HR-Net", "dual"))
        for part in ("<= 20 m", "> 20 m")
    ),
    PaperRow("sharpness", {"method": "w/ HR-Net"}, {"method": "w/ HR-Net", "closest": "True"}, ("ratio",)),
    *(
        PaperRow("sa_region", {"region": region, "method": method}, {"region": region, "variant": variant}, ("abs_rel",))
        for region in ("Road", "Tree & grass")
        for method, variant in (("w/o SA", "dual_no_sa"), ("w/ SA", "dual"))
    ),
    *(
        PaperRow("backbone", {"backbone": name}, {"backbone": name}, _OVERHEAD)
        for name in ("MobileNet V2", "ResNet18", "Dual-network (ResNet50)")
    ),
    *(PaperRow("backbone", {"backbone": name}, {"backbone": name}, _OVERHEAD[2:]) for name in ("w/ pt", "w/o pt")),
    *(
        PaperRow("odometry", {"method": method}, {"variant": variant, "frames": 3}, ("snippet_ate_mean_09", "snippet_ate_mean_10"))
        for method, variant in (("Ours (LR-Net)", ("odometry_lr", "lr")), ("Ours (LR-Net+HR-Net)", ("odometry_dual", "dual")))
    ),
)
"""All rows of the paper that are its own, and ours."""
HIGHER_IS_BETTER = ("a1", "a2", "a3")
DIGITS = {"params_m": 0.01, "gmacs": 0.01}
"""The last digit that the paper prints, where it is not 0.001."""
CLOSEST = "not judged: of all readings of the paper's equation the one that comes closest to its ratio"
COUNTS = ("params_m", "gmacs", "ratio")
"""Numbers that are neither better nor worse."""


def compare_numbers(tables: dict[str, pd.DataFrame], judged: bool) -> pd.DataFrame:
    """Every number of the paper's own rows beside ours, from tables by name: difference, spread and 95 % interval over seeds, and, where
    they are `judged`, verdicts."""
    rows = []
    for pair in PAIRS:
        table = tables.get(pair.table)
        published, ours = _row(table, {"source": "paper"} | pair.paper), _row(table, {"source": "measured"} | pair.ours)
        for metric in pair.metrics if published is not None else ():
            if pd.notna(published.get(metric)):
                words = {"table": pair.table, "row": ", ".join(pair.paper.values()), "metric": metric}
                rows.append(words | _number(published, ours, metric, judged))
    columns = ["table", "row", "metric", "paper", "ours", "difference", "spread", "low", "high", "seeds", "n", "verdict", "note"]
    return pd.DataFrame(rows, columns=columns)


def _number(published: pd.Series, ours: pd.Series | None, metric: str, judged: bool) -> dict[str, Any]:
    paper = float(published[metric])
    if ours is None or pd.isna(ours.get(metric)):
        note = "no row of ours" if ours is None else str(ours.get("note", "")).rsplit("not run: ", 1)[-1] or "no number"
        return {"paper": paper} | Verdict(NOT_RUN, note).columns()
    value, spread = float(ours[metric]), float(ours.get(f"{metric}_std", np.nan))
    seeds = len(str(ours.get("seeds", "")).split()) or 1
    half = t_interval(spread, seeds) if seeds > 1 and not np.isnan(spread) else np.nan
    lower = None if metric in COUNTS else metric not in HIGHER_IS_BETTER
    settings = {"spread": spread, "seeds": seeds, "digit": DIGITS.get(metric, 0.001), "lower_is_better": lower}
    verdict = judge_number(paper, value, **settings) if judged and metric != "ratio" else None
    verdict_columns = verdict.columns() if verdict else {"note": CLOSEST} if metric == "ratio" else {}
    numbers = {"paper": paper, "ours": value, "difference": value - paper, "spread": spread, "low": value - half, "high": value + half}
    return numbers | {"seeds": ours.get("seeds", ""), "n": ours.get(f"n{metric[-3:]}", ours.get("n"))} | verdict_columns
