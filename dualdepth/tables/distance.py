"""Near and far: where the gain of the dual network is."""

from collections.abc import Sequence
from functools import partial

import pandas as pd

from dualdepth.evaluation.distance import PARTS, evaluate_near_far
from dualdepth.results import Run
from dualdepth.scoring import Predictions, protocol, truth
from dualdepth.tables.rows import compare_trainings, training_row, with_paper

ROWS = {"lr": "w/o HR-Net", "dual_no_sa": "w/ HR-Net, w/o SA", "dual": "w/ HR-Net"}
RATIOS = {False: "one median ratio an image", True: "a median ratio for each part"}


def score_part(run: Run, variant: str, seed: int, *, part: str, own_ratio: bool = False) -> pd.DataFrame:
    """Per-image metrics of a training's near or far pixels."""
    disparities = Predictions(run, variant, seed).disparities
    frame = evaluate_near_far(disparities, truth(run), own_ratio=own_ratio, kind="disparity", **protocol(run.profile.evaluation))
    return frame.xs(part, level="distance")


def distance_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's rows and ours, with column `scaling`: one ratio an image (the comparable one), or one for each part."""
    rows = []
    for own_ratio, scaling in RATIOS.items():
        for variant, method in ROWS.items():
            for part in PARTS:
                row = training_row(run, variant, seeds, scores=partial(score_part, part=part, own_ratio=own_ratio))
                rows.append({"method": method, "distance": part, "scaling": scaling, **row})
    return with_paper("distance", rows)


def distance_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The dual network against LR-Net in each part, paired."""
    tables = []
    for part in PARTS:
        table = compare_trainings(run, [("dual", "lr"), ("dual_no_sa", "lr")], seeds, scores=partial(score_part, part=part))
        table.insert(0, "distance", part)
        tables.append(table)
    return pd.concat(tables, ignore_index=True)
