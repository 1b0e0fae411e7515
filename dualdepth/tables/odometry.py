"""The odometry table: errors of short snippets as the paper has them, of whole trajectories, and of three controls."""

from collections.abc import Callable, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dualdepth.data.odometry import poses_path, read_trajectory, sequence_of
from dualdepth.evaluation.leaks import check_leak
from dualdepth.evaluation.odometry import ALIGNMENTS, aligned, relative, yaw_and_step
from dualdepth.evaluation.statistics import mean_std
from dualdepth.run import Run, Sources
from dualdepth.tables.odometry_scoring import (
    CONTROLS,
    LENGTHS,
    SequenceScores,
    chain,
    known_sequences,
    predicted_motions,
    score_control,
    score_sequence,
    scored_drives,
    true_trajectory,
)
from dualdepth.tables.rows import COMPARISON, comparison_row, seed_label, training_note, with_paper
from dualdepth.training.weights import load_card

TRAJECTORY = ("t_err", "r_err", "ate", "rpe_t", "rpe_r")
"""t_err in % of the length, r_err in degrees per 100 m, ate and rpe_t in metres, rpe_r in degrees."""
BLOCK = 50
"""Snippets that are drawn together: five seconds, in which a car's motion is much the same."""
NEEDS = "not run: no ODOMETRY_ROOT; get it with python data_scripts/download_kitti.py --root DIR --odometry"

_sequence = lru_cache(maxsize=256)(score_sequence)
_control = lru_cache(maxsize=64)(score_control)


def odometry_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's rows, then ours and the controls, once for each snippet length (`frames`, the paper's column "#").

    Returns:
        Besides the paper's columns `snippet_ate_mean_SS` and `snippet_ate_std_SS` (over the snippets of sequence SS, metres): true RMSE
        of the snippets, errors of the whole trajectory aligned with 7dof, `n_SS` snippets, and standard deviations over seeds.
    """
    rows = []
    for length in LENGTHS:
        for name, method in _methods(run).items():
            why_not = _why_not(run, name)
            row: dict[str, Any] = {"method": method, "source": "measured", "frames": length}
            rows.append(row | ({"note": why_not} if why_not else _row(run, name, seeds, length)))
    return with_paper("odometry", rows)


def _methods(run: Run) -> dict[str, str]:
    labels = (run.profile.variant(name).label for name in ("odometry_lr", "odometry_dual"))
    return dict(zip(run.profile.pose_variants, labels)) | CONTROLS


def _why_not(run: Run, name: str) -> str:
    """Why a row cannot be run; nothing if it can."""
    if Sources.load(run).odometry_root is None:
        return NEEDS
    if name not in (*CONTROLS, *run.profile.train):
        return f"not run: profile {run.profile.name} does not train it"
    if not sequences(run):
        return f"not run: profile {run.profile.name} scores no sequence"
    return ""


def sequences(run: Run) -> list[str]:
    """The sequences that are scored; none where nothing was trained for them."""
    return run.profile.odometry_sequences()[1] if set(run.profile.pose_variants) & set(run.profile.train) else []


def scored_variants(run: Run) -> list[str]:
    """The trainings that this run scores."""
    return [name for name in run.profile.pose_variants if not _why_not(run, name)]


def scored_with(run: Run, seeds: Sequence[int]) -> list[Path]:
    """What the odometry table is made from, for its stamp: weights and true poses."""
    variants = scored_variants(run)
    if not variants:
        return []
    root = Sources.load(run).odometry_root
    return [run.weights(v, seed) for v in variants for seed in seeds] + [poses_path(root, entry) for entry in sequences(run)]


def _of_seeds(run: Run, name: str, seeds: Sequence[int], entry: str) -> list[SequenceScores]:
    return [_sequence(run, name, seed, entry) for seed in seeds] if name not in CONTROLS else [_control(run, name, entry)]


def _row(run: Run, name: str, seeds: Sequence[int], length: int) -> dict[str, Any]:
    row: dict[str, Any] = {}

    def over_seeds(column: str, scores: list[SequenceScores], value: Callable[[SequenceScores], float]) -> None:
        row[column], row[f"{column}_std"] = mean_std([value(s) for s in scores])

    for entry in sequences(run):
        scores, suffix = _of_seeds(run, name, seeds, entry), sequence_of(entry)[0]
        over_seeds(f"snippet_ate_mean_{suffix}", scores, lambda s: s.snippets[length]["ate"].mean())
        over_seeds(f"snippet_ate_std_{suffix}", scores, lambda s: s.snippets[length]["ate"].std(ddof=0))
        over_seeds(f"snippet_rmse_{suffix}", scores, lambda s: s.snippets[length]["rmse"].mean())
        for metric in TRAJECTORY:
            over_seeds(f"{metric}_{suffix}", scores, lambda s, metric=metric: s.trajectory["7dof"][metric])
        row[f"n_{suffix}"] = len(scores[0].snippets[length])
    row["n"] = sum(row[f"n_{sequence_of(entry)[0]}"] for entry in sequences(run))
    if name in CONTROLS:
        mean = f"the mean step of sequences {' '.join(known_sequences(run))}, never turning"
        meant = {"constant": mean, "straight": "a metre a frame along the optical axis", "inverted": "a mistake that snippets hardly see"}
        return row | {"seeds": "", "note": f"control: {meant[name]}"}
    cut = "each from one output of PoseNet" if length == 3 else "cut from the trajectory"
    train = "" if run.profile.world else f", sequences {' '.join(run.profile.odometry_sequences()[0])}"
    note = f"{training_note(run, name, seeds[0], drives=scored_drives(run, sequences(run)))}{train}; snippets of {length} frames, {cut}"
    return row | {"variant": name, "seeds": seed_label(seeds), "note": note}


def trajectory_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """Errors of the whole trajectories for every alignment: rows per method, sequence and alignment, means and spread over seeds."""
    rows = []
    for name, method in _methods(run).items():
        if _why_not(run, name):
            rows.append({"method": method, "source": "measured", "note": _why_not(run, name)})
            continue
        trained = name not in CONTROLS
        leak = check_leak(load_card(run.weights(name, seeds[0])), scored_drives(run, sequences(run)), allow=True) if trained else ""
        for entry in sequences(run):
            scores = _of_seeds(run, name, seeds, entry)
            for how in ALIGNMENTS:
                row = {"method": method, "sequence": sequence_of(entry)[0], "align": how}
                for metric in TRAJECTORY:
                    row[metric], row[f"{metric}_std"] = mean_std([s.trajectory[how][metric] for s in scores])
                segments = scores[0].trajectory[how]["segments"]
                said = seed_label(seeds) if trained else ""
                notes = ["" if segments else "no segment of 100 m: the path is too short", leak]
                rows.append(row | {"segments": segments, "seeds": said, "source": "measured", "note": "; ".join(filter(None, notes))})
    columns = ["method", "sequence", "align", *TRAJECTORY, "segments", "seeds", "source", "note", *(f"{m}_std" for m in TRAJECTORY)]
    return pd.DataFrame(rows).reindex(columns=columns)


def motion_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """Predicted against true motion, frame by frame: slope and correlation of yaw and of the forward step, means over seeds.

    A slope of 1 is right, 0 is a PoseNet that does not turn. `yaw_mean_error` is predicted less true yaw, degrees a frame,
    to the right: trajectories add it up. Predicted steps have no unit: they are first divided by the mean ratio.
    """
    rows = []
    for name in scored_variants(run):
        for entry in sequences(run):
            fits = [_fit(*motions(run, name, seed, entry)) for seed in seeds]
            row = {"method": _methods(run)[name], "variant": name, "sequence": sequence_of(entry)[0]}
            rows.append(row | pd.DataFrame(fits).mean().to_dict() | {"seeds": seed_label(seeds), "source": "measured"})
    columns = ["method", "variant", "sequence", "yaw_slope", "yaw_correlation", "yaw_mean_error", "step_slope", "step_correlation"]
    columns += ["n", "seeds", "source"]
    return pd.DataFrame(rows, columns=columns)


def motions(run: Run, name: str, seed: int, entry: str) -> tuple[np.ndarray, np.ndarray]:
    """True and predicted yaw (degrees a frame) and forward step (metres a frame) along a sequence, each (N − 1, 2)."""
    truth = yaw_and_step(true_trajectory(run, entry).poses)
    ours = yaw_and_step(chain(predicted_motions(run, name, seed, entry)))
    ours[:, 1] *= truth[:, 1].mean() / ours[:, 1].mean()
    return truth, ours


def _fit(truth: np.ndarray, ours: np.ndarray) -> dict[str, float]:
    values: dict[str, float] = {}
    for column, what in enumerate(("yaw", "step")):
        (variance, covariance), (_, other) = np.cov(truth[:, column], ours[:, column])
        with np.errstate(divide="ignore", invalid="ignore"):
            values |= {f"{what}_slope": covariance / variance, f"{what}_correlation": covariance / np.sqrt(variance * other)}
    return values | {"yaw_mean_error": (ours - truth)[:, 0].mean(), "n": len(truth)}


def odometry_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """PoseNet against each control: t_err of the 7dof-aligned trajectory, and snippets of 3 frames paired; stage 2 against stage 1.

    Snippets depend on their neighbours, so their intervals are of runs of `BLOCK`. t_err is one number a seed: it is said how many
    seeds beat a control.
    """
    rows: list[dict[str, Any]] = []
    trained = scored_variants(run)
    for entry in sequences(run) if trained else []:
        place = f"sequence {sequence_of(entry)[0]}"
        pairs = [(name, control) for name in trained for control in CONTROLS]
        pairs += [(trained[1], trained[0])] if len(trained) == 2 else []
        for a, b in pairs:
            of_a, of_b = _of_seeds(run, a, seeds, entry), _of_seeds(run, b, seeds, entry)
            of_b = of_b * (len(of_a) // len(of_b))
            rows.append({"sequence": place, "a": a, "b": b, "metric": "t_err", **_t_err_row(of_a, of_b)})
            ates = [[s.snippets[3]["ate"].to_numpy() for s in scores] for scores in (of_a, of_b)]
            compared = comparison_row(*ates, lower_is_better=True, block=BLOCK)
            compared["in_words"] = compared["in_words"].replace("images", "snippets")
            rows.append({"sequence": place, "a": a, "b": b, "metric": "snippet_ate_3", **compared})
    return pd.DataFrame(rows, columns=["sequence", *COMPARISON])


def _t_err_row(a: Sequence[SequenceScores], b: Sequence[SequenceScores]) -> dict[str, Any]:
    errors = np.array([[s.trajectory["7dof"]["t_err"] for s in scores] for scores in (a, b)])
    segments = a[0].trajectory["7dof"]["segments"]
    if not segments:
        return {"n": 0, "in_words": "not compared: the path is too short for a segment"}
    difference = errors[0] - errors[1]
    mean, spread = mean_std(difference)
    better = int((difference < 0).sum())
    if not mean:
        return {"n": segments, "in_words": "the same"}
    words = f"{'better' if mean < 0 else 'worse'} by {abs(mean):.3g} points of t_err; better with {better} of {len(difference)} seeds"
    means = {"mean_a": errors[0].mean(), "mean_b": errors[1].mean(), "difference": mean, "spread": spread, "seeds": len(difference)}
    return means | {"n": segments, "in_words": words}


def paths(run: Run, seed: int, entry: str) -> dict[str, np.ndarray]:
    """Positions (N, 3) in metres for a plot, laid on the truth with 7dof: the truth and ours."""
    truth = true_trajectory(run, entry).poses
    shown = {"Ground truth": relative(truth)[:, :3, 3]}
    for name in scored_variants(run):
        _sequence(run, name, seed, entry)
        file = run.results / "trajectories" / f"{name}_seed{seed}_{sequence_of(entry)[0]}.txt"
        shown[run.profile.variant(name).label] = aligned(read_trajectory(file).poses, truth)[:, :3, 3]
    return shown
