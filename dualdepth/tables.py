"""The paper's tables beside ours: published rows with `source` paper, our own with `source` measured."""

from collections.abc import Sequence

import pandas as pd

from dualdepth import paper
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
    for seed in seeds:
        ours.append(row("LR-Net, untrained", "-", score_untrained(run, seed), "before its first step", seed=seed))
        ours.append(row("LR-Net", "-", score_training(run, "lr", seed), _training_note(run), seed=seed))
    table = pd.concat([paper.table("main"), pd.DataFrame(ours)], ignore_index=True)
    table["seed"] = table["seed"].astype("Int64")
    table["n"] = table["n"].astype("Int64")
    return table.fillna({"note": ""})


def _training_note(run: Run) -> str:
    training = run.profile.training
    weights = "ImageNet weights" if training.pretrained else "no ImageNet weights"
    height, width = run.profile.data.lr_size
    return f"{training.encoder}, {height}x{width}, {weights}, last epoch"
