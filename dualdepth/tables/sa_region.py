"""Does SA-Attention help where there is little texture, and only there?"""

import hashlib
import json
from collections.abc import Sequence
from functools import lru_cache, partial
from pathlib import Path

import pandas as pd

from dualdepth.data.label_maps import LabelMaps, label_path
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import METRICS, evaluate_parts
from dualdepth.evaluation.regions import REGIONS, in_regions
from dualdepth.files import file_digest
from dualdepth.run import Run, Sources
from dualdepth.tables.rows import COMPARISON, compare_gains, compare_trainings, seed_label, training_row, with_paper
from dualdepth.tables.scoring import Predictions, scored_frames, truth

ROWS = {"dual_no_sa": "w/o SA", "dual": "w/ SA"}
COLUMNS = ["region", "method", *(f"{m}{end}" for m in METRICS for end in ("", "_std")), "n", "seeds", "source", "variant", "note"]
NO_LABELS = "not run: no LABELS_ROOT; make the maps with python data_scripts/export_labels.py"


def labels_made_by(run: Run) -> str:
    """What made the label maps: the world's renderer, or what `labels.json` beside them says; why there are none.

    Raises:
        InputError: `labels.json` cannot be read.
    """
    root = Sources.load(run).labels_root
    if root is None:
        return NO_LABELS
    if run.profile.world:
        return "exact labels"
    path = Path(root) / "labels.json"
    if not path.exists():
        return "labels of unknown origin"
    try:
        card = json.loads(path.read_text(encoding="utf-8"))
        return f"labels by {card['model']}"
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise InputError(f"{path}: names no model ({error}); delete it or make the maps again with data_scripts/export_labels.py") from None


def labels_digest(run: Run) -> str | None:
    """One digest of the scored frames' label maps, for stamps; None where there are none."""
    root = Sources.load(run).labels_root
    if root is None:
        return None
    digests = [(str(frame), file_digest(label_path(root, frame))) for frame in scored_frames(run)]
    return hashlib.sha256(str(digests).encode()).hexdigest()


@lru_cache(maxsize=64)
def score_regions(run: Run, variant: str, seed: int) -> pd.DataFrame:
    """Per-image metrics of a training's regions; kept while the run is open, since several rows ask for them."""
    label_maps, maps = LabelMaps(Sources.load(run).labels_root, scored_frames(run)), truth(run)
    if len(label_maps) != len(maps):
        raise InputError(f"{run.prepared}: {len(maps)} ground truths but {len(label_maps)} label maps; run notebook 02_prepare_data again")
    disparities, parts = Predictions(run, variant, seed).disparities, in_regions(label_maps, label_maps.paths)
    required = f"a valid pixel of {' or '.join(REGIONS)}; check the label maps, the crop and the depth limits"
    settings = run.profile.evaluation.model_dump()
    return evaluate_parts(disparities, maps, parts, required=required, kind="disparity", **settings)


def score_region(run: Run, variant: str, seed: int, *, part: str) -> pd.DataFrame:
    """Per-image metrics of one region; images that have none of it have no row."""
    frame = score_regions(run, variant, seed)
    return frame[frame.index.get_level_values("part") == part].droplevel("part")


def sa_region_table(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's rows and ours; without label maps ours have no numbers and say so."""
    made_by, rows = labels_made_by(run), []
    for region in REGIONS:
        for variant, method in ROWS.items():
            if made_by == NO_LABELS:
                row = {"variant": variant, "source": "measured", "note": NO_LABELS}
            else:
                row = training_row(run, variant, seeds, scores=partial(score_region, part=region))
                if "n" in row and run.profile.data.has_truth:
                    row["note"] = ", ".join(filter(None, [row["note"], made_by, counted(row["n"], len(scored_frames(run)))]))
            rows.append({"region": region, "method": method, **row})
    return with_paper("sa_region", rows).reindex(columns=COLUMNS)


def counted(n: int, images: int) -> str:
    """How many images have the region; nothing where all have it."""
    return "" if n == images else f"{n} of {images} images; the others have fewer than 1 valid pixel of the region"


def sa_region_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """With SA against without in each region, over all seeds and for each, paired; and whether road gains more: the paper's claim.

    Column `seed` has the seeds that a row is about.
    """
    if labels_made_by(run) == NO_LABELS:
        rows = [
            {"region": r, "seed": seed_label(seeds), "a": "dual", "b": "dual_no_sa", "metric": "", "in_words": NO_LABELS} for r in REGIONS
        ]
        return pd.DataFrame(rows, columns=["region", "seed", *COMPARISON])
    tables = []
    for chosen in [seeds, *([seed] for seed in seeds if len(seeds) > 1)]:
        for region in REGIONS:
            table = compare_trainings(run, [("dual", "dual_no_sa")], chosen, scores=partial(score_region, part=region))
            tables.append(table.assign(region=region, seed=seed_label(chosen)))
        if (tables[-1]["metric"] != "").all():
            gains = compare_gains(run, ("dual", "dual_no_sa"), list(REGIONS), chosen, scores=score_region)
            row = dict(zip("ab", (f"gain of dual, {region}" for region in REGIONS))) | gains
            tables.append(pd.DataFrame([row]).assign(region=" against ".join(REGIONS), seed=seed_label(chosen)))
    return pd.concat(tables, ignore_index=True)[["region", "seed", *COMPARISON]]
