"""The main table: depth on the scored frames, beside the paper's rows and what needs no learning."""

from collections.abc import Sequence

import numpy as np
import pandas as pd

from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.evaluation import baselines
from dualdepth.evaluation.depth import evaluate, resize_bilinear
from dualdepth.run import Run
from dualdepth.tables.rows import method_row, with_paper
from dualdepth.tables.scores import NO_TRUTH, SEEDLESS, Scores, collect, scored, untrained_net

BASELINES = {"mean_map": "Train set mean", "row_mean": "Per-row mean", "constant": "Constant depth"}
UNTRAINED = "untrained"
METHODS = BASELINES | {UNTRAINED: "LR-Net, untrained"}  # What is no training, by name, and the method as the table has it.


def main_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """LR-Net and the dual network, LR-Net of the same seeds before its first step, and the baselines without learning."""
    scores, options = collect(run, ("lr", "dual"), seeds), run.profile.evaluation.model_dump()
    if not run.profile.data.has_truth:
        for name in METHODS:
            scores = scores.plus(name, None, NO_TRUTH)
        return scores
    untrained = {seed: untrained_net(run, seed).disparities(scored(run).paths) for seed in seeds}
    frames = {seed: evaluate(d, scored(run).truth, name=UNTRAINED, kind="disparity", **options) for seed, d in untrained.items()}
    scores = scores.plus(UNTRAINED, frames, "before its first step")
    for name in BASELINES:
        predictions, note = baseline_depths(run, name)
        frames = predictions and {SEEDLESS: evaluate(predictions, scored(run).truth, name=name, kind="depth", **options)}
        scores = scores.plus(name, frames, note)
    return scores


def baseline_depths(run: Run, name: str) -> tuple[Sequence[np.ndarray] | None, str]:
    """What a baseline predicts for each scored frame, in metres, and what it was fitted on; or None, and why.

    It is fitted on training-side laser frames; where the only laser frames are the scored ones, each drive is predicted from the others.
    """
    frames = scored(run)
    if (mean := fitted_depth(run, name)) is not None:
        return [resize_bilinear(mean, depth.shape) for depth in frames.truth], "fitted on training-side laser frames"
    if len(frames.drives) < 2:
        return None, "no training-side laser frames, and the scored frames are of one drive"
    drives = [frame.drive for frame in frames.frames]
    predictions = baselines.leave_one_drive_out(list(frames.truth), drives, name, max_depth=run.profile.evaluation.max_depth)
    return predictions, "fitted on the scored frames of all other drives"


def fitted_depth(run: Run, name: str) -> np.ndarray | None:
    """Depth of a baseline on its grid (`mean_depth`), metres, fitted on training-side laser frames; None where there are none."""
    path = run.prepared / "baseline_truth.npz"
    if not path.exists():
        return None
    return baselines.mean_depth(baselines.depth_sums(load_ground_truth(path), max_depth=run.profile.evaluation.max_depth), name)


def main_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's rows, baselines without learning, LR-Net before and after its training, the dual network.

    Columns method, dataset, supervision, the seven metrics (means over images and seeds), n, source, the metrics' standard deviations
    over seeds, seeds, note, reason, leak. `scores` are those of `main_scores`.
    """
    dataset = {"miniature": "miniature", "kitti": "K", "own": "own"}[run.profile.data.source]
    rows = []
    for name, method in (METHODS | {v: run.profile.variant(v).label for v in ("lr", "dual")}).items():
        row = {"method": method, "dataset": dataset, "supervision": "Depth" if name in BASELINES else "-"}
        rows.append(row | method_row(scores, name, note=scored(run).note))
    return with_paper("main", rows).drop(columns="variant")
