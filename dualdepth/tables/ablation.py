"""The ablation: what HR-Net, SA-Attention and the other choices bring, and a profile's own variants."""

import pandas as pd

from dualdepth.run import Run
from dualdepth.tables.rows import claims_table, comparisons, method_row, paired, with_paper
from dualdepth.tables.scores import Scores, scored

VARIANTS = (
    *("lr", "dual_no_sa", "dual"),
    *("dual_embedding_only", "dual_cosine", "dual_l1", "dual_l2", "dual_mean", "dual_softmax"),
    *("hr_only", "lr_no_feature_loss", "lr_feature_loss", "lr_downsample_first"),
)
"""The paper's three, what in SA-Attention does it, the paper's other claims; `lr_feature_loss` where `lr` has none."""


def own_variants(run: Run) -> list[str]:
    """Trainings on the drives of the depth tables that only this profile has."""
    return [variant for variant in run.profile.trained_on("depth") if variant in run.profile.variants and variant not in VARIANTS]


def ablation_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's three rows and ours: the same three, the extras, the profile's own; means and standard deviations over seeds."""
    shown = [variant for variant in VARIANTS if variant != "lr_feature_loss" or variant in scores.trainings]
    rows = [method_row(scores, variant, note=scored(run).note) for variant in (*shown, *own_variants(run))]
    return with_paper("ablation", [{"method": run.profile.variant(row["variant"]).label, **row} for row in rows])


def ablation_claims(run: Run, scores: Scores) -> pd.DataFrame:
    """The pairs of the paper's claims, and each of the profile's own variants against its `lr` or `dual`, by their stage."""
    own = ((variant, "lr" if run.profile.variant(variant).stage == "lr" else "dual") for variant in own_variants(run))
    more = comparisons(row for pair in own for row in paired(scores, *pair))
    return pd.concat([claims_table(scores, "ablation"), *([more] if len(more) else [])], ignore_index=True)
