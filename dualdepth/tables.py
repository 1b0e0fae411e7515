"""The paper's tables beside ours: published rows with `source` paper, our own with `source` measured."""

from collections.abc import Sequence

import pandas as pd

from dualdepth import paper
from dualdepth.evaluation.statistics import mean_std, paired_bootstrap
from dualdepth.results import Run
from dualdepth.scoring import means, score_baselines, score_training, score_untrained, scored_note

BASELINE_ROWS = {
    "mean_map": "Train set mean",
    "row_mean": "Per-row mean",
    "constant": "Constant depth",
}


def main_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The main table: the paper's rows, baselines without learning, the untrained and the trained LR-Net for each seed.

    Returns:
        Columns method, dataset, supervision, the seven metrics, n, seed, source, note.
    """
    data = "miniature" if run.profile.world else "K"
    fitted = (run.prepared / "baseline_truth.npz").exists()
    fit = "fitted on training-side laser frames" if fitted else "fitted on the scored frames of all other drives"
    note = scored_note(run)

    def row(method: str, supervision: str, scores: pd.DataFrame, *notes: str, seed: int | None = None) -> dict:
        said = "; ".join(filter(None, [*notes, note]))
        return {
            "method": method,
            "dataset": data,
            "supervision": supervision,
            **means(scores),
            "seed": seed,
            "source": "measured",
            "note": said,
        }

    ours = [row(BASELINE_ROWS[name], "Depth", scores, fit) for name, scores in score_baselines(run).items()]
    if not ours:
        why = "not run: no training-side laser frames, and the scored frames are of one drive"
        ours = [{"method": m, "dataset": data, "supervision": "Depth", "source": "measured", "note": why} for m in BASELINE_ROWS.values()]
    for seed in seeds:
        ours.append(row("LR-Net, untrained", "-", score_untrained(run, seed), "before its first step", seed=seed))
        ours.append(row("LR-Net", "-", score_training(run, "lr", seed), _training_note(run), seed=seed))
    table = pd.concat([paper.table("main"), pd.DataFrame(ours)], ignore_index=True)
    table["seed"] = table["seed"].astype("Int64")
    table["n"] = table["n"].astype("Int64")
    return table.fillna({"note": ""})


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
            rows.append(
                {
                    "baseline": BASELINE_ROWS[name],
                    "metric": metric,
                    "of_baseline": scores[metric].mean(),
                    "of_variant": mean,
                    "spread_over_seeds": spread,
                    **difference._asdict(),
                    "clear_of_zero": difference.low > 0 or difference.high < 0,
                }
            )
    return pd.DataFrame(rows)


def _training_note(run: Run) -> str:
    training = run.profile.training
    weights = "ImageNet weights" if training.pretrained else "no ImageNet weights"
    height, width = run.profile.data.lr_size
    return f"{training.encoder}, {height}x{width}, {weights}, last epoch"
