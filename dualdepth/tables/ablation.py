"""The ablation: what HR-Net, SA-Attention and the other choices bring."""

from collections.abc import Sequence

import pandas as pd

from dualdepth.run import Run
from dualdepth.tables.rows import compare_trainings, training_row, with_paper

ROWS = (
    *("lr", "dual_no_sa", "dual"),
    *("dual_embedding_only", "dual_cosine", "dual_l1", "dual_l2", "dual_mean", "dual_softmax"),
    *("hr_only", "lr_no_feature_loss", "lr_downsample_first"),
)
"""The paper's three, what in SA-Attention does it, and the paper's other claims."""
CLAIMS = {
    ("dual", "lr"): "the dual network is better than LR-Net",
    ("dual_no_sa", "lr"): "HR-Net without SA-Attention is better than LR-Net",
    ("dual", "dual_no_sa"): "SA-Attention adds to it",
    ("dual", "dual_embedding_only"): "and does so by its mixing, not by its size",
    ("dual", "hr_only"): "HR-Net is worse without LR-Net's features",
    ("lr", "lr_no_feature_loss"): "the feature reconstruction loss helps",
    ("lr", "lr_downsample_first"): "augmentation before down-sampling helps",
}
"""(better, worse) as the paper has it, and its claim."""


def ablation_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's three rows and ours: the same three, then the extras; means and standard deviations over seeds."""
    return with_paper("ablation", [{"method": run.profile.variant(name).label, **training_row(run, name, seeds)} for name in ROWS])


def ablation_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """Every pair that the paper argues with: claim, paired difference, interval over images, spread over seeds, verdict in words."""
    table = compare_trainings(run, list(CLAIMS), seeds)
    table.insert(0, "claim", [CLAIMS[pair] for pair in zip(table["a"], table["b"])])
    return table
