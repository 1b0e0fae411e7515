"""The main table: depth on the scored frames, beside the paper's rows and what needs no learning."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.evaluation import baselines
from dualdepth.evaluation.depth import evaluate
from dualdepth.run import Run
from dualdepth.tables.rows import MEASURED, comparisons, not_run, over_seeds, paired, seed_label, training_row, with_paper
from dualdepth.tables.scores import Scores, collect, scored, untrained_net

BASELINES = {"mean_map": "Train set mean", "row_mean": "Per-row mean", "constant": "Constant depth"}
UNTRAINED = "untrained"


def main_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """LR-Net and the dual network, LR-Net of the same seeds before its first step, and the baselines without learning."""
    scores = collect(run, ("lr", "dual"), seeds)
    if not run.profile.data.has_truth:
        return scores._replace(missing=scores.missing | dict.fromkeys((*BASELINES, UNTRAINED), scores.missing["lr"]))
    options = run.profile.evaluation.model_dump()
    untrained = {}
    for seed in seeds:
        disparities = untrained_net(run, seed).disparities(scored(run).paths)
        untrained[UNTRAINED, seed] = evaluate(disparities, scored(run).truth, name=UNTRAINED, kind="disparity", **options)
    scores = scores._replace(frame=pd.concat([scores.frame, pd.concat(untrained, names=["variant", "seed"])]))
    for name in BASELINES:
        predictions = baseline_depths(run, name)
        if predictions is None:
            reason = "no training-side laser frames, and the scored frames are of one drive"
            scores = scores._replace(missing=scores.missing | {name: reason})
        else:
            scores = scores.plus(name, evaluate(predictions, scored(run).truth, name=name, kind="depth", **options))
    return scores


def baseline_depths(run: Run, name: str) -> Sequence[np.ndarray] | None:
    """What a baseline predicts for each scored frame, in metres.

    It is fitted on training-side laser frames; where the only laser frames are the scored ones, each drive is predicted from the
    others. None where both fail: no training-side scans and one scored drive.
    """
    frames, fitted = scored(run), run.prepared / "baseline_truth.npz"
    settings = {"grid": baselines.GRID, "max_depth": run.profile.evaluation.max_depth}
    if fitted.exists():
        sums = baselines.depth_sums(load_ground_truth(fitted), **settings)
        return [baselines.predict(sums, name, depth.shape) for depth in frames.truth]
    if len(frames.drives) < 2:
        return None
    return baselines.leave_one_drive_out(list(frames.truth), [frame.drive for frame in frames.frames], name, **settings)


def main_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's rows, baselines without learning, LR-Net before and after its training, the dual network.

    Columns method, dataset, supervision, the seven metrics (means over images and seeds), n, source, the metrics' standard deviations
    over seeds, seeds, note, reason, leak. `scores` are those of `main_scores`.
    """
    fitted = (run.prepared / "baseline_truth.npz").exists()
    fit = "fitted on training-side laser frames" if fitted else "fitted on the scored frames of all other drives"
    rows = []
    for name, method in {**BASELINES, UNTRAINED: "LR-Net, untrained"}.items():
        row = {"method": method, "supervision": "-" if name == UNTRAINED else "Depth"}
        if name in scores.missing:
            rows.append(row | not_run(scores.missing[name]))
            continue
        frame, note = scores.of(name), "before its first step" if name == UNTRAINED else fit
        seeds = seed_label(frame.index.unique("seed")) if name == UNTRAINED else ""
        note = ", ".join(filter(None, [note, scored(run).note]))
        rows.append(row | over_seeds(frame) | {"seeds": seeds, "source": MEASURED, "note": note})
    for variant in ("lr", "dual"):
        row = training_row(scores, variant, note=scored(run).note)
        rows.append({"method": run.profile.variant(variant).label, "supervision": "-", **row})
    dataset = {"miniature": "miniature", "kitti": "K", "own": "own"}[run.profile.data.source]
    return with_paper("main", [row | {"dataset": dataset} for row in rows]).drop(columns="variant")


def main_claims(scores: Scores) -> pd.DataFrame:
    """Each training against each baseline without learning, paired image by image."""
    return comparisons(row for variant in ("lr", "dual") for name in BASELINES for row in paired(scores, variant, name))
