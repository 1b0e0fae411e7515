"""The main table: depth on the scored frames, beside the paper's rows and what needs no learning."""

from collections.abc import Sequence

import pandas as pd

from dualdepth.evaluation.statistics import Difference, mean_std, paired_bootstrap
from dualdepth.run import Run
from dualdepth.tables.rows import NO_TRUTH, mean_row, seed_label, training_row, with_paper
from dualdepth.tables.scoring import score_baselines, score_training, score_untrained, scored_note

BASELINE_ROWS = {"mean_map": "Train set mean", "row_mean": "Per-row mean", "constant": "Constant depth"}


def main_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's rows, baselines without learning, LR-Net before and after its training, the dual network.

    Returns:
        Columns method, dataset, supervision, the seven metrics (means over images and seeds), n, source, the metrics' standard
        deviations over seeds, seeds, note.
    """
    names = {"miniature": "miniature", "kitti": "K", "own": "own"}
    common = {"dataset": names[run.profile.data.source], "source": "measured"}
    fitted = (run.prepared / "baseline_truth.npz").exists()
    fit = "fitted on training-side laser frames" if fitted else "fitted on the scored frames of all other drives"
    fit = "; ".join(filter(None, [fit, scored_note(run)]))
    scores = score_baselines(run)
    missing = "not run: no training-side laser frames, and the scored frames are of one drive" if run.profile.data.has_truth else NO_TRUTH
    rows = []
    for name, method in BASELINE_ROWS.items():
        row = {"method": method, **common, "supervision": "Depth", **(mean_row([scores[name]]) if scores else {})}
        rows.append(row | {"note": fit if scores else missing})
    untrained = {"method": "LR-Net, untrained", "supervision": "-", "note": NO_TRUTH}
    if run.profile.data.has_truth:
        note = "; ".join(filter(None, ["before its first step", scored_note(run)]))
        untrained |= {**mean_row([score_untrained(run, seed) for seed in seeds]), "seeds": seed_label(seeds), "note": note}
    rows.append(untrained | common)
    for variant in ("lr", "dual"):
        rows.append({"method": run.profile.variant(variant).label, "supervision": "-", **training_row(run, variant, seeds), **common})
    return with_paper("main", rows).drop(columns="variant")


def compare_with_baselines(run: Run, variant: str, seeds: Sequence[int]) -> pd.DataFrame:
    """A trained variant against each baseline without learning, image by image.

    Returns:
        Rows per baseline and metric (abs_rel, a1): both means, the spread of the variant's mean over seeds, the paired
        difference (variant − baseline) and its 95 % bootstrap interval over images, and whether that is clear of zero.
    """
    trained = [score_training(run, variant, seed) for seed in seeds]
    rows = []
    for name, scores in score_baselines(run).items():
        for metric in ("abs_rel", "a1"):
            ours = sum(frame[metric] for frame in trained) / len(trained)
            mean, spread = mean_std([frame[metric].mean() for frame in trained])
            difference = paired_bootstrap(ours, scores[metric], seed=0)
            row = {"variant": variant, "baseline": BASELINE_ROWS[name], "metric": metric, "of_baseline": scores[metric].mean()}
            row |= {"of_variant": mean, "spread_over_seeds": spread, **difference._asdict()}
            rows.append(row | {"clear_of_zero": difference.low > 0 or difference.high < 0})
    columns = ["variant", "baseline", "metric", "of_baseline", "of_variant", "spread_over_seeds", *Difference._fields, "clear_of_zero"]
    return pd.DataFrame(rows, columns=columns)
