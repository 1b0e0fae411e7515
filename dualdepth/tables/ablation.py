"""The ablation: what HR-Net, SA-Attention and the other choices bring."""

import pandas as pd

from dualdepth.run import Run
from dualdepth.tables.rows import method_row, with_paper
from dualdepth.tables.scores import Scores, scored

VARIANTS = (
    *("lr", "dual_no_sa", "dual"),
    *("dual_embedding_only", "dual_cosine", "dual_l1", "dual_l2", "dual_mean", "dual_softmax"),
    *("hr_only", "lr_no_feature_loss", "lr_feature_loss", "lr_downsample_first"),
)
"""The paper's three, what in SA-Attention does it, the paper's other claims; `lr_feature_loss` where `lr` has none."""


def ablation_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's three rows and ours: the same three, then the extras; means and standard deviations over seeds."""
    shown = [variant for variant in VARIANTS if variant != "lr_feature_loss" or variant in scores.trainings]
    rows = [method_row(scores, variant, note=scored(run).note) for variant in shown]
    return with_paper("ablation", [{"method": run.profile.variant(row["variant"]).label, **row} for row in rows])
