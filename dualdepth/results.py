"""Where a run's files lie, and the stamps that say what made them."""

import ast
import datetime
import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Iterable
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

import dualdepth
from dualdepth.atomic import write_json, write_text
from dualdepth.config import Profile, load_profile
from dualdepth.errors import InputError

PACKAGE = Path(__file__).parent

CODE = {
    "world": ("data_scripts.make_miniature", "data_scripts.miniature", "data_scripts.prepare_data", "preparation", "data.sources"),
    "prepare": (
        *("data_scripts.prepare_data", "data_scripts.export_depth", "preparation"),
        *("data.kitti", "data.triplets", "data.lidar", "data.depth_maps", "data.odometry"),
    ),
    "train_lr": (
        *("networks.encoders", "networks.decoder", "networks.lr_net", "networks.pose_net", "geometry", "losses", "stages", "training"),
        *("building", "precision", "data.bad_frames"),
        *("data.augmentation", "data.loading", "data.kitti", "data.triplets"),
    ),
    "train_hr": ("networks.hr_net", "networks.attention", "networks.dual_net", "networks.architecture", "hr_stage"),
    "odometry": ("data.odometry",),
    "predict": (
        *("predict", "scoring", "make3d_scoring", "odometry_scoring", "networks"),
        *("evaluation.depth", "evaluation.baselines", "evaluation.make3d"),
        *(
            "data.augmentation",
            "data.loading",
            "data.kitti",
            "data.depth_maps",
            "data.make3d",
            "data.mat",
            "data.odometry",
            "data.trajectories",
        ),
    ),
    "tables": ("tables", "paper", "plots", "figures", "evaluation", "data.label_maps", "leaks"),
    "report": ("report", "verdicts", "assumptions"),
    "quickstart": ("model", "figures", "plots"),
}
"""Modules whose code shapes a step's result; a change in one of them makes the step stale."""


def project_root() -> Path:
    """The checkout: the nearest folder, from here upwards, that holds both `notebooks/` and `Snakefile`.

    Raises:
        InputError: there is none.
    """
    here = Path.cwd()
    for folder in (here, *here.parents):
        if (folder / "notebooks").is_dir() and (folder / "Snakefile").is_file():
            return folder
    raise InputError(f"{here} is not inside a dualdepth checkout: go to the folder that holds the Makefile")


class Run:
    """Files of a profile: `work/<profile>/` for data and weights, `results/<profile>/` for what is shown."""

    def __init__(self, profile: str, root: Path | None = None) -> None:
        self.profile: Profile = load_profile(profile)
        self.root = root or project_root()
        self.work = self.root / "work" / self.profile.name
        self.results = self.root / "results" / self.profile.name
        self.began = time.perf_counter()

    @property
    def sources(self) -> Path:
        """What notebook 01 found: roots and lists."""
        return self.work / "sources.json"

    @property
    def given(self) -> Path:
        """What the last run of the chain was given: folders, seeds."""
        return self.work / "given.json"

    @property
    def prepared(self) -> Path:
        """Folder of the prepared index and ground truth (notebook 02)."""
        return self.work / "prepared"

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
        return {"variant": network, **profile.values("data.hr_size", f"training.{chosen.stage}", *_SHAPING)}

    def settings_digest(self, variant: str) -> str:
        """Digest of them."""
        return _short_digest(json.dumps(self.settings(variant), sort_keys=True))

    def training_code(self, variant: str) -> str:
        """Digest of the code that shapes a variant's weights."""
        chosen = self.profile.variant(variant)
        return code_digest("train_lr", *["train_hr"] * (chosen.stage == "hr"), *["odometry"] * (chosen.trains_on == "odometry"))

    def index(self, variant: str) -> Path:
        """The prepared triplets that a variant trains on (notebook 02)."""
        return self.prepared / {"depth": "triplets.csv", "odometry": "odometry.csv"}[self.profile.variant(variant).trains_on]

    def recipe(self, variant: str, seed: int) -> str:
        """Digest of all that shapes a training's weights, its own seed aside: settings, code, prepared triplets, stage 1's weights."""
        files = (self.index(variant), self.prepared / "identity.json")
        data = [file_digest(self.require(path, "02_prepare_data")) for path in files]
        start = self.profile.variant(variant).starts_from
        data += [file_digest(self.weights(start, seed))] if start else []
        return _short_digest(self.settings_digest(variant), self.training_code(variant), str(data))

    def scored_with(self, variants: Iterable[str], seeds: Iterable[int]) -> list[Path]:
        """What a table of these trainings is made from, for its stamp: weights, scored frames, ground truth."""
        weights = [self.weights(v, seed) for v in variants if v in self.profile.train for seed in seeds]
        return [*weights, self.prepared / "test_frames.json", self.prepared / "ground_truth.npz"]

    def require(self, path: Path, notebook: str) -> Path:
        """`path`, checked to be there.

        Raises:
            InputError: it is missing; the message names the notebook that makes it.
        """
        if not path.exists():
            raise InputError(f"{path.relative_to(self.root)} is missing: run notebook {notebook} with profile {self.profile.name} first")
        return path

    def save_table(self, table: pd.DataFrame, name: str, inputs: Iterable[Path], **facts: Any) -> Path:
        """Write `results/<profile>/tables/<name>.csv` and its stamp."""
        path = self.results / "tables" / f"{name}.csv"
        write_text(path, table.to_csv(index=False, float_format="%.6g"))
        write_json(path.with_suffix(".json"), self.stamp(inputs) | facts)
        return path

    def save_figure(self, figure: Any, name: str, inputs: Iterable[Path], **facts: Any) -> Path:
        """Write `results/<profile>/figures/<name>.png` and its stamp."""
        from dualdepth import plots

        path = plots.save(figure, self.results / "figures" / f"{name}.png")
        write_json(path.with_suffix(".json"), self.stamp(inputs) | facts)
        return path

    def stamp(self, inputs: Iterable[Path]) -> dict[str, Any]:
        """Provenance: revision, hashes of lock, profile and inputs, versions, machine, time; seconds are since this run was opened."""
        return {
            "seconds": round(time.perf_counter() - self.began, 1),
            "device": device_name(),
            "made": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
            "version": dualdepth.__version__,
            "revision": self._revision[0],
            "dirty": self._revision[1],
            "profile": self.profile.name,
            "profile_sha256": hashlib.sha256(self.profile.model_dump_json().encode()).hexdigest(),
            "lock_sha256": file_digest(self.root / "environment.lock"),
            "inputs_sha256": {str(p.relative_to(self.root) if p.is_relative_to(self.root) else p): file_digest(p) for p in inputs},
            **({"allow_leak": True} if self.allow_leak else {}),
            "python": platform.python_version(),
            "machine": f"{platform.system()} {platform.machine()}",
        }

    @property
    def allow_leak(self) -> bool:
        """Whether this run may score what was trained on; its results then say so."""
        from dualdepth.preparation import Sources  # which imports this module

        return self.sources.exists() and Sources.load(self).allow_leak

    @cached_property
    def _revision(self) -> tuple[str, bool]:
        def git(*words: str) -> str:
            return subprocess.run(["git", "-C", str(self.root), *words], capture_output=True, text=True, check=False).stdout.strip()

        return git("rev-parse", "HEAD") or "unknown", bool(git("status", "--porcelain"))


def _short_digest(*parts: str) -> str:
    return hashlib.sha256(" ".join(parts).encode()).hexdigest()[:16]


def device_name() -> str:
    """The GPU's name, or the CPU's with the number of threads used; nothing is loaded to find out."""
    torch = sys.modules.get("torch")
    if torch and torch.cuda.is_available():
        return torch.cuda.get_device_name()
    information = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    models = [line.partition(":")[2].strip() for line in information.splitlines() if line.startswith("model name")]
    return f"{models[0] if models else 'CPU'}, {torch.get_num_threads() if torch else os.cpu_count()} threads"


_SHAPING = (
    "training.encoder",
    "training.pretrained",
    "training.augmentation",
    "training.loss",
    "training.precision",
    "training.channels_last",
)
"""Settings of `Training` that shape the weights, beside the stage's own; not what fits it to machine and files (`accumulate`,
`on_bad_frame`)."""


def file_digest(path: Path) -> str | None:
    """sha256 of a file, or None where there is none."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def folder_digest(folder: str | Path, *patterns: str) -> str:
    """Digest of names, sizes and times of files below a folder, to notice cheaply that they were replaced; of nothing for no folder."""
    files = sorted(path for pattern in patterns for path in Path(folder).glob(pattern)) if folder else []
    return _short_digest(*(f"{path.name} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in files))


def code_digest(*steps: str) -> str:
    """Digest of the code of some steps' modules, blind to comments, docstrings and layout."""
    return hashlib.sha256("".join(_code(module) for step in steps for module in CODE[step]).encode()).hexdigest()[:16]


def code_digests(*steps: str) -> dict[str, str]:
    """The same of each module, by its name."""
    return {module: _short_digest(_code(module)) for step in steps for module in CODE[step]}


def _code(module: str) -> str:
    path = (PACKAGE.parent if module.startswith("data_scripts") else PACKAGE) / module.replace(".", "/")
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    return "".join(_meaning(file.read_text(encoding="utf-8")) for file in files)


def notebook_digest(name: str) -> str:
    """Digest of a notebook's code, blind to its prose and outputs."""
    path = project_root() / "notebooks" / f"{name}.ipynb"
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return hashlib.sha256(json.dumps(["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]).encode()).hexdigest()[:16]


def _meaning(source: str) -> str:
    """The syntax tree without the strings that stand alone."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return ast.dump(tree)
