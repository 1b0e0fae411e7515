"""A folder that looks like a checkout, with a profile of small trainings and prepared triplets."""

import json
from collections.abc import Sequence
from pathlib import Path

from data_scripts.prepare_data import write_identity
from dualdepth.data.triplets import drive_triplets, raw_triplets, write_triplets
from dualdepth.run import Run, Sources
from tests.small_kitti import DRIVE


def write_profile(path: Path, encoder: str, training: dict, hr_size: Sequence[int] = (192, 192), **more: object) -> str:
    """Write a profile with more settings of `training` and more sections; gives its path, as `Run` and `load_profile` take it."""
    usual = {"encoder": encoder, "pretrained": False, "workers": 0, "precision": "float32", "checkpoint_every": 2, "log_every": 1}
    data = {"source": "kitti", "train_drives": [DRIVE], "hr_size": hr_size}
    path.write_text(json.dumps({"about": "a test", "data": data, "training": usual | training, **more}))  # JSON is YAML
    return str(path)


def checkout_of(root: Path, *arguments: object, **more: object) -> Run:
    """A run of a profile, which is written with what else is given, in a folder that looks like a checkout."""
    (root / "notebooks").mkdir(exist_ok=True)
    (root / "Snakefile").touch()
    return Run(write_profile(root / "own.yaml", *arguments, **more), root)


def prepare(run: Run, drive: str = DRIVE) -> None:
    """Do what notebooks 01 and 02 do, for the training on one drive of `kitti` below the run's root."""
    kitti = run.root / "kitti"
    sources = Sources(kitti_root=kitti, test_list=run.root / "test_files.txt")
    sources.save(run)
    targets = drive_triplets(kitti, [drive])
    triplets = raw_triplets(kitti, targets)
    write_triplets(run.index("lr"), kitti, triplets)
    write_identity(run, sources, targets, [path for triplet in triplets for path in triplet.paths])
