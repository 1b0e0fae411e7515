"""Near and far: where the gain of the dual network is."""

from collections.abc import Sequence
from functools import lru_cache, partial
from typing import Any

import pandas as pd

from dualdepth.evaluation.depth import evaluate_parts
from dualdepth.evaluation.distance import PARTS, near_and_far
from dualdepth.run import Run
from dualdepth.tables.rows import COMPARISON, compare_gains, compare_trainings, training_row, with_paper
from dualdepth.tables.scoring import Predictions, truth

ROWS = {"lr": "w/o HR-Net", "dual_no_sa": "w/ HR-Net, w/o SA", "dual": "w/ HR-Net"}
RATIOS = {False: "one median ratio an image", True: "a median ratio for each part"}


@lru_cache(maxsize=256)
def near_far(run: Run, variant: str, seed: int, own_ratio: bool = False) -> pd.DataFrame:
    """Per-image metrics of a training's near and far pixels; kept while the run is open, since several rows ask for them."""
    disparities = Predictions(run, variant, seed).disparities
    settings = run.profile.evaluation.model_dump()
    return evaluate_parts(disparities, truth(run), near_and_far, own_ratio=own_ratio, kind="disparity", **settings)


def score_part(run: Run, variant: str, seed: int, *, part: str, own_ratio: bool = False) -> pd.DataFrame:
    """Per-image metrics of one part; images without such pixels have no row."""
    frame = near_far(run, variant, seed, own_ratio)
    return frame[frame.index.get_level_values("part") == part].droplevel("part")


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
    """The dual networks against LR-Net in each part, paired; and whether the far part gains more, which is the paper's claim."""
    tables = []
    for part in PARTS:
        table = compare_trainings(run, [("dual", "lr"), ("dual_no_sa", "lr")], seeds, scores=partial(score_part, part=part))
        tables.append(table.assign(distance=part))
    trained = [variant for variant in ("dual", "dual_no_sa") if {variant, "lr"} <= set(run.profile.train) and run.profile.data.has_truth]
    gains = [far_gain(run, variant, seeds, relative) for variant in trained for relative in (False, True)]
    tables.append(pd.DataFrame(gains, columns=COMPARISON).assign(distance="far against near"))
    table = pd.concat([t for t in tables if len(t)], ignore_index=True)
    return table[["distance", *COMPARISON]]


def far_gain(run: Run, variant: str, seeds: Sequence[int], relative: bool) -> dict[str, Any]:
    """Is the far part's gain in Abs Rel over LR-Net larger than the near part's?"""
    (near, far), name = PARTS, "relative gain" if relative else "gain"
    compared = compare_gains(run, (variant, "lr"), (far, near), seeds, scores=score_part, relative=relative)
    return {"a": f"{name} of {variant}, {far}", "b": f"{name}, {near}"} | compared
