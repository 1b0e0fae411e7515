"""Near and far: where the gain of the dual network is."""

from itertools import product

import pandas as pd

from dualdepth.evaluation.parts import PARTS
from dualdepth.run import Run
from dualdepth.tables.rows import comparisons, gains, method_row, paired, with_paper
from dualdepth.tables.scores import Scores, scored

METHODS = {"lr": "w/o HR-Net", "dual_no_sa": "w/ HR-Net, w/o SA", "dual": "w/ HR-Net"}
RATIOS = {False: "one median ratio an image", True: "a median ratio for each part"}


def distance_table(run: Run, by_ratio: dict[bool, Scores]) -> pd.DataFrame:
    """The paper's rows and ours, with column `scaling`: one ratio an image (the comparable one), or one for each part.

    `by_ratio` has the scores of `near_and_far` pixels by the `own_ratio` of `Trained.parts`.
    """
    rows = []
    for (own_ratio, scores), (variant, method), part in product(by_ratio.items(), METHODS.items(), PARTS):
        row = method_row(scores, variant, part=part, note=scored(run).note)
        rows.append({"method": method, "distance": part, "scaling": RATIOS[own_ratio], **row})
    return with_paper("distance", rows)


def distance_claims(scores: Scores) -> pd.DataFrame:
    """The dual networks against LR-Net in each part, paired; and whether the far part gains more, which is the paper's claim."""
    pairs, (near, far) = [("dual", "lr"), ("dual_no_sa", "lr")], PARTS
    rows = [row for part in PARTS for pair in pairs for row in paired(scores, *pair, part=part)]
    rows += [row for pair in pairs for relative in (False, True) for row in gains(scores, pair, (far, near), relative=relative)]
    return comparisons(rows)
