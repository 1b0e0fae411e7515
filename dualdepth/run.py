"""Where a run's files lie, what it was given, the stamps that say what made its results, and what makes a step of the chain stale.

Snakemake notes what a step is made from beside its input files (`Run.made_from`) with the step's outputs, makes the step anew when one of
these differs, and names it in a dry run (`make status`).
"""

import argparse
import ast
import datetime
import functools
import hashlib
import json
import os
import platform
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from pydantic import TypeAdapter

from dualdepth import __version__
from dualdepth.errors import InputError, reading
from dualdepth.files import atomic_path, file_digest, short_digest, write_json
from dualdepth.profile import Profile, load_profile

if TYPE_CHECKING:
    import pandas as pd
    from matplotlib.figure import Figure

RECORD = "own.json"  # What data_scripts/own_camera.py writes beside a data set of an own camera: what it was made from.
ROOTS = {
    "kitti_root": "folder that holds 2011_09_26 and the other days; else what the profile needs is downloaded",
    "test_list": "frames to score instead of the profile's, in the field's format",
    "odometry_root": "folder that holds KITTI odometry's sequences and poses",
    "make3d_root": "folder that holds Make3D's Test134 and Gridlaserdata",
    "labels_root": "folder of label maps, as data_scripts/export_labels.py writes them",
}
"""Where a user's own data are: handed to notebook 01."""


def add_roots(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where the data are."""
    for name, meaning in ROOTS.items():
        parser.add_argument(f"--{name.replace('_', '-')}", default="", metavar="FILE" if name == "test_list" else "DIR", help=meaning)
    parser.add_argument("--allow-leak", action="store_true", help="score even drives that were trained on, and mark the results")


def check_roots(given: Mapping[str, str]) -> None:
    """Make sure that the folders and files that a user gives, by the names of `ROOTS`, are what they should be; else an `InputError`."""
    from dualdepth.data.kitti import check_root, read_frame_list
    from dualdepth.data.label_maps import check_labels_root
    from dualdepth.data.make3d import find_pairs
    from dualdepth.data.odometry import check_odometry_root

    for name, check in zip(ROOTS, (check_root, read_frame_list, check_odometry_root, find_pairs, check_labels_root)):
        if given.get(name):
            check(given[name])


def parse_seeds(text: str) -> list[int]:
    """Seeds of a text such as `0,1,2`, or of an empty one; an `InputError` for all but different whole numbers from 0 to 2³² − 1."""
    seeds = [int(part) if re.fullmatch(r"\s*[0-9]{1,10}\s*", part) else -1 for part in text.split(",") if text]
    if len({*seeds}) < len(seeds) or not all(0 <= seed < 2**32 for seed in seeds):
        raise InputError(f"seeds {text!r}: give different whole numbers from 0 to 4294967295 between commas, such as 0,1,2")
    return seeds


def project_root() -> Path:
    """The checkout: the nearest folder, from here upwards, that holds both `notebooks/` and `Snakefile`, else an `InputError`."""
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "notebooks").is_dir() and (folder / "Snakefile").is_file():
            return folder
    raise InputError(f"{here} is not inside a dualdepth checkout: go to the folder that holds the Makefile")


_SHAPING = (
    *("training.encoder", "training.pretrained", "training.augmentation", "training.loss", "training.beyond_paper_residual"),
    *("training.beyond_paper_residual_floor", "training.beyond_paper_residual_anchor", "training.beyond_paper_corridor_steps"),
    *("training.beyond_paper_refined_after", "training.beyond_paper_pose_encoder", "training.beyond_paper_average"),
    *("training.precision", "training.channels_last", "training.compile", "training.deterministic"),
)
"""Training settings that change the weights, beside the stage's own. Settings that only fit the machine are left out."""


class Run:
    """Files of a profile: `work/<profile>/` for data and weights, `results/<profile>/` for what is shown."""

    def __init__(self, profile: str, root: Path | None = None) -> None:
        self.profile: Profile = load_profile(profile)
        self.root = root or project_root()
        self.work = self.root / "work" / self.profile.name
        self.results = self.root / "results" / self.profile.name
        self.sources = self.work / "sources.json"
        """What notebook 01 found: roots and lists."""
        self.prepared = self.work / "prepared"
        """Folder of the prepared index and ground truth (notebook 02)."""
        self.began = time.perf_counter()

    def training(self, variant: str, seed: int) -> Path:
        """Folder of one training."""
        return self.work / "runs" / variant / f"seed{seed}"

    def weights(self, variant: str, seed: int) -> Path:
        """Released weights of one training."""
        return self.training(variant, seed) / "model.safetensors"

    def settings(self, variant: str) -> dict[str, Any]:
        """The settings that shape a variant's weights; how it is logged and loaded is not among them."""
        chosen, profile = self.profile.variant(variant), self.profile.of_variant(variant)
        network = chosen.model_dump(mode="json", exclude={"label", "about", "set", "trains_on"})
        shaping = [name for name in _SHAPING if chosen.stage == "hr" or "residual" not in name]
        return {"variant": network, **profile.values("data.hr_size", f"training.{chosen.stage}", *shaping)}

    def index(self, variant: str) -> Path:
        """The prepared triplets that a variant trains on (notebook 02)."""
        return self.prepared / {"depth": "triplets.csv", "odometry": "odometry.csv"}[self.profile.variant(variant).trains_on]

    def recipe(self, variant: str, seed: int) -> str:
        """Digest of all that shapes a training's weights, its own seed aside: settings, code, prepared triplets, stage 1's weights."""
        files = (self.index(variant), self.prepared / "identity.json")
        data = [file_digest(self.require(path, "02_prepare_data")) for path in files]
        start = self.profile.variant(variant).starts_from
        data += [file_digest(self.weights(start, seed))] if start else []
        return short_digest(json.dumps(self.settings(variant), sort_keys=True), code_digest("training"), str(data))

    def scored_with(self, variants: Iterable[str], seeds: Iterable[int]) -> list[Path]:
        """What a table of these trainings is made from, for its stamp: weights, scored frames, ground truth."""
        weights = [self.weights(v, seed) for v in variants if v in self.profile.train for seed in seeds]
        return [*weights, self.prepared / "test_frames.json", self.prepared / "ground_truth.npz"]

    def require(self, path: Path, notebook: str) -> Path:
        """`path`, checked to be there; where it is missing, an `InputError` names the notebook that makes it."""
        if not path.exists():
            raise InputError(f"{path.relative_to(self.root)} is missing: run notebook {notebook} with profile {self.profile.name} first")
        return path

    def save_table(self, table: "pd.DataFrame", name: str, inputs: Iterable[Path], **facts: Any) -> "pd.DataFrame":
        """Write `results/<profile>/tables/<name>.csv` and its stamp; gives the table."""
        self._save("tables", f"{name}.csv", lambda path: table.to_csv(path, index=False, float_format="%.6g"), inputs, facts)
        return table

    def save_figure(self, figure: "Figure", name: str, inputs: Iterable[Path], **facts: Any) -> "Figure":
        """Write `results/<profile>/figures/<name>.png` and its stamp; gives the figure."""
        self._save("figures", f"{name}.png", lambda path: figure.savefig(path, dpi=100), inputs, facts)
        return figure

    def _save(self, folder: str, name: str, write: Callable[[Path], object], inputs: Iterable[Path], facts: dict[str, Any]) -> None:
        path = self.results / folder / name
        with atomic_path(path) as partial:
            write(partial)
        write_json(path.with_suffix(".json"), self.stamp(inputs) | facts)

    def stamp(self, inputs: Iterable[Path]) -> dict[str, Any]:
        """Provenance: revision, hashes of lock, profile and inputs, versions, machine, time; seconds are since this run was opened."""
        from dualdepth.device import device_name

        return {
            "seconds": round(time.perf_counter() - self.began, 1),
            "device": device_name(),
            "made": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "version": __version__,
            **self._revision,
            "profile": self.profile.name,
            "profile_sha256": hashlib.sha256(self.profile.model_dump_json().encode()).hexdigest(),
            "lock_sha256": file_digest(self.root / "environment.lock"),
            "inputs_sha256": {
                str(p.relative_to(self.root if p.is_relative_to(self.root) else [*p.parents][:3][-1])): file_digest(p) for p in inputs
            },
            **({"allow_leak": True} if self.sources.exists() and Sources.load(self).allow_leak else {}),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
        }

    def made_from(self, notebook: str, step: str, **kinds: Mapping[str, Any]) -> list[tuple[str, Any]]:
        """All that shapes a step's result beside its input files, by name: its notebook, the `CODE` of `step`, and more `kinds`."""
        cells = {notebook: notebook_digest(self.root / "notebooks" / f"{notebook}.ipynb")}
        named = {"notebook": cells, "code": {part: _digest(part) for part in CODE[step]}, **kinds}
        return [(f"{kind} {name}", value) for kind, values in named.items() for name, value in _leaves(values)]

    @functools.cached_property
    def _revision(self) -> dict[str, Any]:
        """Revision of the checkout whose code this run loaded, and whether it was changed since; not of a repository around it."""

        def git(*words: str) -> str:
            own = {name: value for name, value in os.environ.items() if not name.startswith("GIT_")}  # a hook's are its repository's
            command = ["git", "--git-dir", str(self.root / ".git"), "--work-tree", str(self.root), *words]
            return subprocess.run(command, capture_output=True, text=True, check=False, env=own).stdout.strip()

        own = shutil.which("git") and git("rev-parse", "HEAD")
        return {"revision": own or "unknown", "dirty": bool(own and git("status", "--porcelain"))}


def open_run(profile: str, seeds: object) -> tuple[Run, list[int]]:
    """The run and the seeds of a notebook's parameters; prints what the profile's numbers describe."""
    run = Run(profile)
    print(run.profile.about)
    return run, parse_seeds(str(seeds))


class Sources(NamedTuple):
    """Roots and lists of a run; lists that a profile does not use are None."""

    kitti_root: Path
    test_list: Path
    train_list: Path | None = None
    train_drives: tuple[str, ...] = ()  # Training drives where the profile names none: those of the synthetic world.
    static_frames: Path | None = None
    test_scenes: Path | None = None
    odometry_root: Path | None = None  # Holds `sequences` and `poses`; None: no odometry here.
    make3d_root: Path | None = None  # Holds `Test134` and `Gridlaserdata`; None: no Make3D here.
    labels_root: Path | None = None  # Holds `<drive>/<frame>.png`, Cityscapes training ids of the scored frames; None: no labels here.
    allow_leak: bool = False  # Score even what was trained on; the results then say so.

    def save(self, run: "Run") -> None:
        """Write `work/<profile>/sources.json`."""
        write_json(run.sources, {k: str(v) if isinstance(v, Path) else v for k, v in self._asdict().items()})

    @classmethod
    def load(cls, run: Run) -> "Sources":
        """Read what notebook 01 wrote; an `InputError` if it is not there, or is something else."""
        path = run.require(run.sources, "01_download_data")
        with reading(path, "run notebook 01_download_data again"):
            return TypeAdapter(cls).validate_json(path.read_bytes())


PACKAGE = Path(__file__).parent
NETWORKS = ("networks", "geometry", "refinement", "training", "data", "device")
SCORES = (*NETWORKS, "model", "evaluation", "tables")
CODE = {
    "data": ("data_scripts", "data", "geometry", "tables/plots"),
    "training": (*NETWORKS, "losses"),
    "training_page": (*NETWORKS, "losses", "tables/plots"),
    "predict": SCORES,
    "tables": (*SCORES, "paper"),
    "report": (*SCORES, "paper", "report"),
    "quickstart": (*SCORES, "paper", "data_scripts"),
}
"""Folders and modules of `dualdepth`, and the folder `data_scripts`, whose code shapes a result; a change in one makes it stale.

`training` is what a training's weights are of, `predict` the scores kept beside them; the others are of steps of the chain.
"""


def code_digest(step: str) -> str:
    """Digest of the code that shapes a step's result, blind to comments, docstrings and layout."""
    return short_digest(*map(_digest, CODE[step]))


@functools.cache
def _digest(part: str) -> str:
    """Digest of a folder's or a module's syntax trees without the strings that stand alone."""
    path = (PACKAGE.parent if part == "data_scripts" else PACKAGE) / part
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    trees = [ast.parse(file.read_text(encoding="utf-8")) for file in files]
    for node in (node for tree in trees for node in ast.walk(tree)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return short_digest(*map(ast.dump, trees))


def notebook_digest(path: Path) -> str:
    """Digest of a notebook's code, blind to its prose and outputs."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return short_digest(json.dumps(["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]))


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
