"""Does SA-Attention help where there is little texture, and only there?"""

import hashlib
import json
from collections.abc import Sequence
from pathlib import Path

import pandas as pd

from dualdepth.data.label_maps import label_path
from dualdepth.errors import reading
from dualdepth.evaluation.depth import METRICS
from dualdepth.evaluation.parts import REGIONS, in_regions
from dualdepth.files import file_digest
from dualdepth.run import Run, Sources
from dualdepth.tables.rows import comparisons, gains, method_row, paired, seed_label, with_paper
from dualdepth.tables.scores import Scores, collect, scored

METHODS = {"dual_no_sa": "w/o SA", "dual": "w/ SA"}
COLUMNS = ["region", "method", *(f"{m}{end}" for m in METRICS for end in ("", "_std")), "n", "source", "variant"]
NO_LABELS = "no LABELS_ROOT; make the maps with python data_scripts/export_labels.py"


def labels_made_by(run: Run) -> str:
    """What made the label maps: the world's renderer, or what `labels.json` beside them says, an `InputError` if it cannot be read or names
    no model; or why there are none."""
    root = Sources.load(run).labels_root
    if root is None:
        return NO_LABELS
    if run.profile.world:
        return "exact labels"
    path = Path(root) / "labels.json"
    if not path.exists():
        return "labels of unknown origin"
    with reading(path, "delete it or make the maps again with data_scripts/export_labels.py"):
        return f"labels by {json.loads(path.read_text(encoding='utf-8'))['model']}"


def labels_digest(run: Run) -> str | None:
    """One digest of the scored frames' label maps, for stamps; None where there are none."""
    root = Sources.load(run).labels_root
    if root is None:
        return None
    digests = [(str(frame), file_digest(label_path(root, frame))) for frame in scored(run).frames]
    return hashlib.sha256(str(digests).encode()).hexdigest()


def region_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """Scores of each region of the scored frames, with and without SA-Attention."""
    root, frames = Sources.load(run).labels_root, scored(run)
    if root is None:
        return collect(run, METHODS, seeds, reason=NO_LABELS)
    parts = in_regions(frames.label_map, [label_path(root, frame) for frame in frames.frames])
    required = f"a valid pixel of {' or '.join(REGIONS)}; check the label maps, the crop and the depth limits"
    return collect(run, METHODS, seeds, lambda training: training.parts(parts, required=required))


def region_table(run: Run, scores: Scores) -> pd.DataFrame:
    """The paper's rows and ours; without label maps ours have no numbers and say so."""
    rows, images = [], len(scored(run).frames)
    for region in REGIONS:
        for variant, method in METHODS.items():
            row = method_row(scores, variant, part=region, note=scored(run).note)
            if "note" in row:
                fewer = f"{row['n']} of {images} images; the others have fewer than 1 valid pixel of the region"
                row["note"] = ", ".join(filter(None, [row["note"], labels_made_by(run), fewer if row["n"] != images else ""]))
            rows.append({"region": region, "method": method, **row})
    return with_paper("sa_region", rows).reindex(columns=[*COLUMNS, "seeds", "note", "reason", "leak"])


def region_claims(scores: Scores, seeds: Sequence[int]) -> pd.DataFrame:
    """With SA against without in each region, over all seeds and for each, paired; and whether road gains more: the paper's claim. Column
    `seed` has the seeds that a row is about."""
    rows = []
    for chosen in [seeds, *([seed] for seed in seeds if len(seeds) > 1)]:
        of_seeds = scores if scores.missing else scores._replace(frame=scores.frame[scores.frame.index.isin(chosen, level="seed")])
        found = [row for region in REGIONS for row in paired(of_seeds, "dual", "dual_no_sa", part=region)]
        rows += [row | {"seed": seed_label(chosen)} for row in found + gains(of_seeds, ("dual", "dual_no_sa"), list(REGIONS))]
    return comparisons(rows, "seed")
