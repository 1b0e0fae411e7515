"""What the paper claims, and which of its claims and numbers hold, by the rules that the report has in words (`report.yaml`)."""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from dualdepth.evaluation.statistics import Comparison, t_interval
from dualdepth.paper import DEPTH

REPRODUCED, WITHIN_NOISE, NOT_REPRODUCED, NOT_RUN = "reproduced", "within noise", "not reproduced", "not run"
HIGHER_IS_BETTER = ("a1", "a2", "a3", "f1", "lateral_f1")  # Of all metrics that are compared; of the others lower is better.
TOLERANCE = 0.02  # Share of the paper's number within which ours counts as the same; half of the last printed digit counts, too.


class Verdict(NamedTuple):
    """One of the four words, and what a reader must know beside it."""

    word: str
    why: str = ""


def judge_number(metric: str, paper: float, ours: float, *, spread: float, seeds: int) -> Verdict:
    """Whether a number of the `paper` is reproduced by `ours`, a mean over `seeds` with standard deviation `spread` (NaN for one)."""
    if np.isnan(ours):
        return Verdict(NOT_RUN)
    difference = ours - paper
    if abs(difference) <= max(TOLERANCE * abs(paper), COUNTS.get(metric, 0.001) / 2) * (1 + 1e-9):
        return Verdict(REPRODUCED)
    if metric not in COUNTS and (difference > 0) == (metric in HIGHER_IS_BETTER):
        return Verdict(REPRODUCED, "better than the paper's")
    if seeds > 1 and abs(difference) <= t_interval(spread, seeds):
        return Verdict(WITHIN_NOISE)
    return Verdict(NOT_REPRODUCED)


def judge_claim(comparison: Comparison, *, lower_is_better: bool) -> Verdict:
    """Whether a claim of the paper holds, by the comparison of the method that is claimed to be better with the other."""
    if np.isnan(comparison.difference):
        return Verdict(NOT_RUN)
    one = "" if comparison.seeds > 1 else "one seed"
    if not comparison.clear_of_images or comparison.clear_of_seeds is False:
        return Verdict(WITHIN_NOISE, one)
    return Verdict(REPRODUCED if (comparison.difference < 0) == lower_is_better else NOT_REPRODUCED, one)


class Claim(NamedTuple):
    """A claim: `a` is better than `b` by a row of a table of comparisons (`rows.COMPARISON`)."""

    text: str
    table: str  # Whose comparisons tell: `<table>_claims.csv` in `results/<profile>/tables`.
    a: str
    b: str
    of: str = ""  # Images, or part of them.
    metrics: tuple[str, ...] = ("abs_rel", "a1")
    needs: "Claim | None" = None  # What must hold as well: to gain more is nothing without a gain.
    of_paper: bool = True  # Whether the paper says so; else the table alone has it.
    least: float = 0.0  # What `a` must reach as well, where higher is better; to be better at what neither can do proves nothing.
    instead: tuple[str, str] | None = None  # They stand for `a`, `b` where one is not trained, or one alone began with ImageNet's.
    times: float = 1.0  # How many times `b`'s mean, a share, `a` must reach as well, or so many times fewer failures.


_FAR = Claim("The gain is clear far away", "distance", "dual", "lr", "> 20 m", ("abs_rel",))
_ROAD = Claim("SA-Attention helps on road", "sa_region", "dual", "dual_no_sa", "Road", ("abs_rel",))
CLAIMS = (
    Claim("The dual network is better than LR-Net", "ablation", "dual", "lr"),
    Claim("HR-Net without SA-Attention is better than LR-Net", "ablation", "dual_no_sa", "lr"),
    Claim("SA-Attention adds to it", "ablation", "dual", "dual_no_sa"),
    Claim("SA-Attention adds to it by its mixing, not by its size", "ablation", "dual", "dual_embedding_only", of_paper=False),
    Claim("HR-Net is worse without LR-Net's features", "ablation", "dual", "hr_only"),
    Claim("The feature reconstruction loss helps", "ablation", "lr", "lr_no_feature_loss", instead=("lr_feature_loss", "lr")),
    Claim("Augmenting before down-sampling helps", "ablation", "lr", "lr_downsample_first"),
    Claim("The gain is largest far away", "distance", *("gain of dual, > 20 m", "gain of dual, <= 20 m"), "", ("abs_rel",), _FAR),
    Claim("Edges of the dual network are sharper", "sharpness", "dual", "lr", "boundaries", ("f1",), least=0.1),
    Claim("Slim poles are seen", "sharpness", "dual", "lr", "poles", ("a1",), times=2.0),
    _ROAD,
    Claim(
        "SA-Attention helps more on road than on tree & grass",
        *("sa_region", "gain of dual, Road", "gain of dual, Tree & grass", "", ("abs_rel",), _ROAD),
    ),
    *(
        Claim(f"The dual network is better than {name} at high resolution", "backbone", "dual", b, instead=("dual_scratch", b))
        for name, b in (("ResNet18", "resnet18"), ("MobileNet V2", "mobilenet_v2"))
    ),
    Claim("ImageNet weights help", "backbone", "dual", "dual_scratch"),
    Claim("Stage 2 betters the poses of sequence 09", "odometry", "dual", "lr", "sequence 09", ("snippet_ate_3",)),
    Claim("Stage 2 betters the poses of sequence 10", "odometry", "dual", "lr", "sequence 10", ("snippet_ate_3",)),
)
"""What the paper claims, as far as a difference tells."""


def claims_of(table: str) -> list[Claim]:
    """The claims that a table tells of."""
    return [claim for claim in CLAIMS if claim.table == table]


def judge_claims(tables: dict[str, pd.DataFrame]) -> pd.DataFrame:
    """Every claim of the paper: both means, the difference, its interval over images, its spread over seeds, the verdict.

    `tables` are of comparisons, by file name; one that is missing leaves its claims not run.
    """
    rows = []
    for claim in (claim for claim in CLAIMS if claim.of_paper):
        for metric in claim.metrics:
            found, verdict = _judge(tables, claim, metric)
            if claim.needs and verdict.word == REPRODUCED:
                first = _judge(tables, claim.needs, metric)[1]
                if first.word != REPRODUCED:
                    verdict = Verdict(first.word, first.why if first.word == NOT_RUN else "more than the other, but is it a gain at all?")
            rows.append({"claim": claim.text, "metric": metric, **found, "verdict": verdict.word, "note": verdict.why})
    columns = ["claim", "metric", "mean_a", "mean_b", "difference", "low", "high", "spread", "seeds", "n", "verdict", "note"]
    return pd.DataFrame(rows).reindex(columns=columns)


def _judge(tables: dict[str, pd.DataFrame], claim: Claim, metric: str) -> tuple[dict[str, Any], Verdict]:
    """The comparison that a claim rests on, and its verdict; nothing where it was not made."""
    table = tables.get(f"{claim.table}_claims", pd.DataFrame(columns=["a", "b", "of", "metric"], dtype=object))
    # the PoseNets that are scored on KITTI have trainings of their own
    pairs = zip(table["a"].str.removeprefix("odometry_"), table["b"].str.removeprefix("odometry_"))
    rows = table[np.array([pair in ((claim.a, claim.b), claim.instead) for pair in pairs], bool)]
    rows = rows[rows["of"].astype(object).fillna("").eq(claim.of)] if claim.of else rows
    rows = rows[rows["metric"].astype(object).fillna("").isin([metric, ""])]
    if rows.empty:
        return {}, Verdict(NOT_RUN, "no comparison was made")
    row = rows.iloc[0]
    if pd.isna(row["difference"]):
        return {}, Verdict(NOT_RUN, row["reason"])
    found = Comparison(*(float(row[name]) for name in Comparison._fields[:-1]), int(row["seeds"]))
    verdict = judge_claim(found, lower_is_better=row["better"] == "lower")
    fewer = 1 - (1 - found.mean_b) / claim.times  # a share above one half cannot double
    bar = max(claim.least, min(claim.times * found.mean_b, fewer)) if claim.least or claim.times > 1 else -np.inf
    if verdict.word == REPRODUCED and found.mean_a < bar:
        verdict = Verdict(NOT_REPRODUCED, f"better, but {found.mean_a:.3f} is below the {bar:.3f} that counts as seeing them")
    return found._asdict() | {"n": row["n"]}, verdict


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
CLOSEST = "not judged: of all readings of the paper's equation the one that comes closest to its ratio"
COUNTS = {"params_m": 0.01, "gmacs": 0.01}
"""Numbers that are neither better nor worse, and the last digit of them that the paper prints; of all others it is 0.001."""


def compare_numbers(tables: dict[str, pd.DataFrame], judged: bool) -> pd.DataFrame:
    """Every number of the paper's own rows beside ours, from tables by name: difference, spread and 95 % interval over seeds, and, where
    they are `judged`, verdicts."""
    rows = []
    for pair in PAIRS:
        table = tables.get(pair.table)
        published, ours = _row(table, pair.paper, of_paper=True), _row(table, pair.ours, of_paper=False)
        for metric in pair.metrics if published is not None else ():
            if pd.notna(published.get(metric)):
                words = {"table": pair.table, "row": ", ".join(pair.paper.values()), "metric": metric}
                rows.append(words | _number(published, ours, metric, judged))
    columns = ["table", "row", "metric", "paper", "ours", "difference", "spread", "low", "high", "seeds", "n", "verdict", "note"]
    return pd.DataFrame(rows, columns=columns)


def _row(table: pd.DataFrame | None, where: Mapping[str, str | int | tuple[str, ...]], of_paper: bool) -> pd.Series | None:
    """The first row of the paper, or of ours, with these values; None where there is none."""
    if table is None or not {"source", *where} <= set(table):
        return None
    serving = {column: value if isinstance(value, tuple) else (value,) for column, value in where.items()}
    masks = [table[column].isin(v) | table[column].astype(str).isin(v) for column, v in serving.items()]
    mask = np.logical_and.reduce([(table["source"] == "paper") == of_paper, *masks])
    return table[mask].iloc[0] if mask.any() else None


def _number(published: pd.Series, ours: pd.Series | None, metric: str, judged: bool) -> dict[str, Any]:
    paper = float(published[metric])
    if ours is None or pd.isna(ours.get(metric)):
        reason = "no row of ours" if ours is None else str(ours.get("reason", "")) or "no number"
        return {"paper": paper, "verdict": NOT_RUN, "note": reason}
    value, spread = float(ours[metric]), float(ours.get(f"{metric}_std", np.nan))
    seeds = len(str(ours.get("seeds", "")).split()) or 1
    half = t_interval(spread, seeds) if seeds > 1 and not np.isnan(spread) else np.nan
    numbers = {"paper": paper, "ours": value, "difference": value - paper, "spread": spread, "low": value - half, "high": value + half}
    numbers |= {"seeds": ours.get("seeds", ""), "n": ours.get(f"n{metric[-3:]}", ours.get("n"))}
    if metric == "ratio":
        return numbers | {"note": CLOSEST}
    if not judged:
        return numbers
    verdict = judge_number(metric, paper, value, spread=spread, seeds=seeds)
    return numbers | {"verdict": verdict.word, "note": verdict.why}
