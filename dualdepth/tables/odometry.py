"""The odometry table: errors of short snippets as the paper has them, of whole trajectories, and of three controls."""

from collections.abc import Sequence
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from dualdepth.data.odometry import drives_of, poses_path, sequence_of
from dualdepth.evaluation.odometry import ALIGNMENTS, aligned, relative, yaw_and_step
from dualdepth.run import Run, Sources
from dualdepth.tables import trajectories
from dualdepth.tables.rows import MEASURED, comparisons, method_row, not_run, over_seeds, paired, seed_label, with_paper
from dualdepth.tables.scores import SEEDLESS, Scores, Trained, collect

TRAJECTORY = ("t_err", "r_err", "ate", "rpe_t", "rpe_r")
"""t_err in % of the length, r_err in degrees per 100 m, ate and rpe_t in metres, rpe_r in degrees."""
REFINED = "_refined"  # Behind the name of a training: its PoseNet's motions, refined with its depth.
BLOCK = 50  # Snippets that are drawn together: five seconds, in which a car's motion is much the same.


def odometry_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """Scores of both stages' PoseNets along the test sequences, and of the controls; parts as of `follow`."""
    entries, reason = sequences(run), ""
    if Sources.load(run).odometry_root is None:
        reason = trajectories.NO_SEQUENCES
    elif not entries:
        reason = f"profile {run.profile.name} scores no sequence"
    drives = drives_of(entries, world=run.profile.world is not None)
    variants = run.profile.pose_variants
    scores = collect(run, variants, seeds, lambda t: pd.concat([trajectories.follow(t, e) for e in entries]), reason=reason, drives=drives)
    for variant, of_seeds in list(scores.trainings.items()):
        frames = {t.seed: pd.concat([trajectories.follow(t, entry, refine=True) for entry in entries]) for t in of_seeds}
        scores = scores.plus(variant + REFINED, frames, "")
        scores.trainings[variant + REFINED] = of_seeds
    unknown = reason or ("" if run.profile.odometry_sequences()[0] else "no sequence is trained on, whose mean step this would be")
    given = [] if unknown else trajectories.known_sequences(run)
    unknown = unknown or ("" if given else "there are no true poses of training sequences, whose mean step this would be")
    known = f"the mean step of sequences {' '.join(given)}, never turning"
    notes = {"constant": known, "straight": "a metre a frame along the optical axis", "inverted": "a mistake that snippets hardly see"}
    for name in trajectories.CONTROLS:
        missing = unknown if name == "constant" else reason
        frames = None if missing else {SEEDLESS: pd.concat([trajectories.follow_control(run, name, entry) for entry in entries])}
        scores = scores.plus(name, frames, missing or f"control: {notes[name]}")
    return scores


def sequences(run: Run) -> list[str]:
    """The sequences that are scored; none where nothing was trained for them."""
    return run.profile.odometry_sequences()[1] if set(run.profile.pose_variants) & set(run.profile.train) else []


def names(run: Run) -> list[str]:
    """Their names in tables."""
    return [sequence_of(entry)[0] for entry in sequences(run)]


def made_from(run: Run, scores: Scores) -> list[Path]:
    """What the odometry table is made from, for its stamp: weights and true poses."""
    poses = [poses_path(Sources.load(run).odometry_root, entry) for entry in sequences(run)] if scores.weights else []
    return scores.weights + poses


def _methods(run: Run, scores: Scores) -> dict[str, str]:
    labels = (run.profile.variant(name).label for name in ("odometry_lr", "odometry_dual"))
    ours = dict(zip(run.profile.pose_variants, labels))
    return ours | {v + REFINED: f"{ours[v]}, poses refined" for v in ours if v + REFINED in scores.trainings} | trajectories.CONTROLS


def odometry_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's rows, then ours and the controls, once for each snippet length (`frames`, the paper's column "#").

    Besides the paper's columns `snippet_ate_mean_SS` and `snippet_ate_std_SS` (over the snippets of sequence SS, metres): true RMSE of the
    snippets, errors of the whole trajectory aligned with 7dof, `n_SS` snippets, and standard deviations over seeds.
    """
    rows, train = [], [f"sequences {' '.join(run.profile.odometry_sequences()[0])}"] if "odometry_lr" in run.profile.pose_variants else []
    for length in trajectories.LENGTHS:
        cut = f"snippets of {length} frames, {'each from one triplet' if length == 3 else 'cut from the trajectory'}"
        for name, method in _methods(run, scores).items():
            how = ["refined by direct image alignment, in the unit of the disparities, beyond the paper"] if name.endswith(REFINED) else []
            row = method_row(scores, name, (), note="" if name in trajectories.CONTROLS else ", ".join([*train, *how, cut]))
            numbers = {} if name in scores.missing else _numbers(run, scores, name, length)
            rows.append({"method": method, "frames": length, **row, **numbers})
    return with_paper("odometry", rows)


def _numbers(run: Run, scores: Scores, name: str, length: int) -> dict[str, Any]:
    row: dict[str, Any] = {}
    for sequence in names(run):
        frame = scores.of(name, f"{sequence}, {length} frames")
        means, spread = over_seeds(frame, ("ate", "rmse")), frame["ate"].groupby(level="seed").std(ddof=0)
        row |= {f"snippet_ate_mean_{sequence}": means["ate"], f"snippet_ate_mean_{sequence}_std": means["ate_std"]}
        row |= {f"snippet_ate_std_{sequence}": spread.mean(), f"snippet_ate_std_{sequence}_std": spread.std()}
        row |= {f"snippet_rmse_{sequence}": means["rmse"], f"snippet_rmse_{sequence}_std": means["rmse_std"]}
        path = over_seeds(scores.of(name, f"{sequence}, 7dof"), TRAJECTORY)
        row |= {f"{metric}_{sequence}{end}": path[f"{metric}{end}"] for metric in TRAJECTORY for end in ("", "_std")}
        row[f"n_{sequence}"] = means["n"]
    return row | {"n": sum(row[f"n_{sequence}"] for sequence in names(run))}


def trajectory_table(run: Run, scores: Scores) -> pd.DataFrame:
    """Errors of the whole trajectories for every alignment: rows per method, sequence and alignment, means and spread over seeds."""
    rows = []
    for name, method in _methods(run, scores).items():
        if name in scores.missing:
            rows.append({"method": method} | not_run(scores.missing[name]))
            continue
        for sequence, how in product(names(run), ALIGNMENTS):
            segments = int(scores.of(name, f"{sequence}, {how}")["segments"].iloc[0])
            row = {"method": method, "sequence": sequence, "align": how, "segments": segments}
            note = "" if segments else "no segment of 100 m: the path is too short"
            rows.append(row | method_row(scores, name, TRAJECTORY, f"{sequence}, {how}") | {"note": note})
    columns = ["method", "sequence", "align", *TRAJECTORY, "segments", "seeds", "source", "note", "reason", "leak"]
    return pd.DataFrame(rows).reindex(columns=[*columns, *(f"{m}_std" for m in TRAJECTORY)])


def motion_table(run: Run, scores: Scores) -> pd.DataFrame:
    """Predicted against true motion, frame by frame: slope and correlation of yaw and of the forward step, means over seeds.

    A slope of 1 is right, 0 is a PoseNet that does not turn. `yaw_mean_error` is predicted less true yaw, degrees a frame,
    to the right: trajectories add it up. Predicted steps have no unit: they are first divided by the mean ratio.
    """
    rows = []
    for (variant, of_seeds), entry in product(scores.trainings.items(), sequences(run)):
        fits = pd.DataFrame([_fit(*motions(training, entry, variant.endswith(REFINED))) for training in of_seeds]).mean().to_dict()
        row = {"method": _methods(run, scores)[variant], "variant": variant, "sequence": sequence_of(entry)[0]}
        rows.append(row | fits | {"seeds": seed_label(t.seed for t in of_seeds), "source": MEASURED})
    columns = ["method", "variant", "sequence", "yaw_slope", "yaw_correlation", "yaw_mean_error", "step_slope", "step_correlation"]
    return pd.DataFrame(rows, columns=[*columns, "n", "seeds", "source"])


def motions(training: Trained, entry: str, refine: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """True and predicted yaw (degrees a frame) and forward step (metres a frame) along a sequence, each (N − 1, 2)."""
    truth = yaw_and_step(trajectories.true_trajectory(training.run, entry).poses)
    ours = yaw_and_step(trajectories.chain(trajectories.predicted_motions(training, entry, refine)))
    ours[:, 1] *= truth[:, 1].mean() / ours[:, 1].mean()
    return truth, ours


def _fit(truth: np.ndarray, ours: np.ndarray) -> dict[str, float]:
    values: dict[str, float] = {}
    for column, what in enumerate(("yaw", "step")):
        (variance, covariance), (_, other) = np.cov(truth[:, column], ours[:, column])
        with np.errstate(divide="ignore", invalid="ignore"):
            values |= {f"{what}_slope": covariance / variance, f"{what}_correlation": covariance / np.sqrt(variance * other)}
    return values | {"yaw_mean_error": (ours - truth)[:, 0].mean(), "n": len(truth)}


def odometry_claims(run: Run, scores: Scores) -> pd.DataFrame:
    """PoseNet against each control: t_err of the 7dof-aligned trajectory, and snippets of 3 frames paired; stage 2 against stage 1.

    Snippets depend on their neighbours, so their intervals are of runs of `BLOCK`. t_err is one number a seed: it is said how many
    seeds beat a control.
    """
    rows: list[dict[str, Any]] = []
    ours = list(scores.trainings)
    trained, refined = ([v for v in ours if v.endswith(REFINED) == beyond] for beyond in (False, True))
    stages = [*zip(trained[1:], trained), *zip(refined[1:], refined), *zip(refined, trained)]
    for sequence in names(run) if ours else ():
        for a, b in (*product(ours, [name for name in trajectories.CONTROLS if name not in scores.missing]), *stages):
            place = f"sequence {sequence}"
            rows.append({"of": place, "a": a, "b": b, "metric": "t_err"} | _t_errs(*(scores.of(v, f"{sequence}, 7dof") for v in (a, b))))
            for row in paired(scores, a, b, ["ate"], part=f"{sequence}, 3 frames", block=BLOCK, of=place):
                rows.append(row | {"metric": "snippet_ate_3", "in_words": row.get("in_words", "").replace("images", "snippets")})
    return comparisons(rows)


def _t_errs(a: pd.DataFrame, b: pd.DataFrame) -> dict[str, Any]:
    """Comparison of the t_err of each seed; of a control there is one."""
    segments = int(a["segments"].iloc[0])
    if not segments:
        return {"n": 0, "reason": "the path is too short for a segment"}
    errors = np.broadcast_arrays(a["t_err"].to_numpy(), b["t_err"].to_numpy())
    difference = errors[0] - errors[1]
    mean, spread = difference.mean(), pd.Series(difference).std()
    better = int((difference < 0).sum())
    words = f"{'better' if mean < 0 else 'worse'} by {abs(mean):.3g} points of t_err; better with {better} of {len(difference)} seeds"
    means = {"mean_a": errors[0].mean(), "mean_b": errors[1].mean(), "difference": mean, "spread": spread, "seeds": len(difference)}
    return means | {"n": segments, "better": "lower", "in_words": words if mean else "the same"}


def paths(run: Run, scores: Scores, entry: str) -> dict[str, np.ndarray]:
    """Positions (N, 3) in metres for a plot, laid on the truth with 7dof: the truth and the first seed's of each training."""
    truth = trajectories.true_trajectory(run, entry).poses
    shown = {"Ground truth": relative(truth)[:, :3, 3]}
    for variant, of_seeds in scores.trainings.items():
        poses = trajectories.chain(trajectories.predicted_motions(of_seeds[0], entry, refine := variant.endswith(REFINED)))
        shown[of_seeds[0].label + ", refined" * refine] = aligned(poses, truth)[:, :3, 3]
    return shown
