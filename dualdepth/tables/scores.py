"""Scores of a run: the frames that are scored, a training as it is scored, and one long frame of scores for a table."""

import contextlib
import functools
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import torch
from pydantic import TypeAdapter

from dualdepth.data.depth_maps import DepthMaps, load_ground_truth
from dualdepth.data.kitti import Frame, image_path
from dualdepth.data.label_maps import label_path, read_label_map
from dualdepth.device import default_device
from dualdepth.errors import InputError, reading
from dualdepth.evaluation.depth import METRICS, Parts, evaluate_parts, resize_bilinear, whole
from dualdepth.evaluation.leaks import check_leak
from dualdepth.files import atomic_path, file_digest, write_json
from dualdepth.model import DepthModel, load
from dualdepth.networks.architecture import Architecture
from dualdepth.run import Run, Sources, code_digest
from dualdepth.training.weights import load_card

NO_TRUTH = "an own camera has no ground truth"
SHOWN_MEDIAN = 10.0
"""Median depth that a map without ground truth is shown with: its scale is unknown, and the colour scale goes from 3 to 80."""


class Scored:
    """The frames that a run scores, in the order of their ground truth. An `InputError` says that notebook 02, which lists them, was not
    run, or that its list is something else."""

    def __init__(self, run: Run) -> None:
        path = run.require(run.prepared / "test_frames.json", "02_prepare_data")
        with reading(path, "run notebook 02_prepare_data again"):
            found = json.loads(path.read_bytes())
            self.frames, listed = TypeAdapter(list[Frame]).validate_python(found["frames"]), int(found["listed"])
        self.run, self.drives = run, sorted({frame.drive for frame in self.frames})
        self.note = "" if len(self.frames) == listed else f"{len(self.frames)} of {listed} frames"
        """What a table must say of an incomplete list, such as "25 of 697 frames"; else empty."""

    @functools.cached_property
    def truth(self) -> DepthMaps:
        """Laser depth (H, W) of each frame in metres, 0 where there is none."""
        return load_ground_truth(self.run.require(self.run.prepared / "ground_truth.npz", "02_prepare_data"))

    @functools.cached_property
    def paths(self) -> list[Path]:
        """Image files; an `InputError` if one is gone since notebook 02."""
        root = Sources.load(self.run).kitti_root
        found = [image_path(root, frame) for frame in self.frames]
        if None in found:
            raise InputError(f"{root}: has no image of scored frame {self.frames[found.index(None)]}; run notebook 02_prepare_data again")
        return found

    def exact_depth(self, image: int) -> np.ndarray | None:
        """Exact depth (H, W) in metres, 0 in the sky: the synthetic world has it, real KITTI does not."""
        frame = self.frames[image]
        path = self.run.work / "miniature" / "dense_depth" / frame.drive.split("/")[-1] / f"{frame.index:010d}.npy"
        return np.load(path) if self.run.profile.world else None

    def label_map(self, image: int) -> np.ndarray | None:
        """Cityscapes training ids (H, W), or None where the run has no label maps; the synthetic world has them."""
        root = Sources.load(self.run).labels_root
        return read_label_map(label_path(root, self.frames[image])) if root else None

    def title(self, image: int) -> str:
        """Drive and number of a frame, for pictures."""
        return f"{self.frames[image].drive.split('/')[-1]} {self.frames[image].index}"

    @property
    def unit(self) -> str:
        """What the colour bar of depth maps says behind its numbers."""
        return "m" if self.run.profile.data.has_truth else f"(scale unknown: median {SHOWN_MEDIAN:g})"


def scored(run: Run) -> Scored:
    """`Scored` of a run, read once as long as notebook 02 is not run again."""
    return opened(Scored, (run,), run.prepared / "test_frames.json")


class Trained:
    """A training as it is scored: its card, predictions and scores. What is computed is kept beside the weights while it fits them."""

    def __init__(self, run: Run, variant: str, seed: int) -> None:
        self.run, self.variant, self.seed = run, variant, seed
        self.stage, self.folder = run.profile.variant(variant).stage, run.training(variant, seed)
        self.label = run.profile.variant(variant).label

    @functools.cached_property
    def weights(self) -> Path:
        """The weights that the training kept; where they are missing, an `InputError` names the notebook that makes them."""
        notebook = "03_train_lr" if self.stage == "lr" else "04_train_hr"
        return self.run.require(self.run.weights(self.variant, self.seed), f"{notebook}, variant {self.variant}, seed {self.seed},")

    @functools.cached_property
    def card(self) -> dict[str, Any]:
        """What the weights are and what they learned from."""
        return load_card(self.run.weights(self.variant, self.seed))

    @property
    def model(self) -> DepthModel:
        """The depth network in the tables' precision, float32."""
        return load(self.weights, default_device(), "float32")

    def check(self, drives: Iterable[str]) -> None:
        """Refuse to score frames of drives that were trained on, unless the run allows it."""
        check_leak(self.card, drives, allow=Sources.load(self.run).allow_leak, weights=self.weights)

    def describe(self) -> str:
        """Backbone, input size, weights it began with and steps, from the card."""
        card, data = self.card, self.run.profile.data
        network = self.run.profile.variant(self.variant).network
        height, width = data.lr_size if network == "lr" else data.hr_size
        before = f" after {card['starts_from']['steps']} of stage 1" if card["starts_from"] else ""
        parts = [card["encoder"]] if network != "hr" else []
        parts += [f"{height}x{width}", "ImageNet weights" if card["pretrained"] else "no ImageNet weights"]
        parts += ["learned with refined poses"] if card.get("refined") else []
        parts += ["anchored where images are flat"] if card.get("anchored") else []
        return ", ".join([*parts, f"{card['steps']} steps{before}", "weights averaged" if card.get("average") else "last epoch"])

    def kept(self, name: str, made_from: dict[str, Any], make: Callable[[], Any]) -> Any:
        """What `make` gives, an array (`name` ends in .npy; mapped from the file) or a frame by image (.csv).

        It is kept as the file `name` beside the weights, and made anew unless it was made from just this, by just this code.
        """
        path = self.folder / name
        made_from = {"weights": file_digest(self.weights), **made_from, "code": code_digest("predict")}
        stamp = path.with_suffix(".json")
        fits, is_array = False, path.suffix == ".npy"
        with contextlib.suppress(OSError, ValueError):  # no stamp, or a damaged one
            fits = json.loads(stamp.read_text(encoding="utf-8")) == made_from and path.exists()
        if not fits:
            stamp.unlink(missing_ok=True)  # a kill between the two must not leave an old stamp beside a new file
            made = make()
            with atomic_path(path) as partial:
                np.save(partial, made) if is_array else made.to_csv(partial)
            write_json(stamp, made_from)
        return np.load(path, mmap_mode="r") if is_array else pd.read_csv(path, index_col="image")

    @functools.cached_property
    def disparities(self) -> np.ndarray:
        """(N, h, w) of the scored frames, at the network's own size; kept as `disparities.npy`, as the field saves it. An `InputError` says
        that the weights are missing, or were trained on drives of the scored frames."""
        frames = scored(self.run)
        self.check(frames.drives)
        return self.kept("disparities.npy", self._of_frames, lambda: self.model.disparities(frames.paths))

    @property
    def _of_frames(self) -> dict[str, Any]:
        """What says that the scored frames are the same."""
        return {name: file_digest(self.run.prepared / name) for name in ("test_frames.json", "ground_truth.npz")}

    def parts(self, parts: Parts, **options: Any) -> pd.DataFrame:
        """`evaluate_parts` of the scored frames by the profile's protocol: rows (image, part)."""
        options = {"name": str(self.folder / "disparities.npy"), "kind": "disparity", **self.run.profile.evaluation.model_dump(), **options}
        return evaluate_parts(self.disparities, scored(self.run).truth, parts, **options)

    @functools.cached_property
    def scores(self) -> pd.DataFrame:
        """Metrics and `scale_ratio` of each scored frame, by its place (`image`); kept as `per_image.csv`.

        Without ground truth no metric has a value, and `scale_ratio` gives the median depth `SHOWN_MEDIAN`.
        """
        self.check(scored(self.run).drives)
        if not self.run.profile.data.has_truth:
            frame = pd.DataFrame({name: np.nan for name in METRICS}, index=pd.RangeIndex(len(self.disparities), name="image"))
            return frame.assign(scale_ratio=[SHOWN_MEDIAN * float(np.median(d)) for d in self.disparities], valid_pixels=0)
        made_from = self._of_frames | self.run.profile.values("evaluation")
        return self.kept("per_image.csv", made_from, lambda: self.parts(whole).droplevel("part"))

    def depth(self, image: int, size: tuple[int, int] | None = None) -> np.ndarray:
        """Depth of a scored frame in metres, median-scaled and clamped as it is scored, resized to `size` (H, W) or the ground truth's;
        without ground truth its unit is a tenth of the map's median."""
        settings, size = self.run.profile.evaluation, size or scored(self.run).truth[image].shape
        disparity = np.asarray(self.disparities[image])
        enlarged = resize_bilinear(1.0 / disparity, size) if settings.resize == "depth" else 1.0 / resize_bilinear(disparity, size)
        return np.clip(enlarged * self.scores.loc[image, "scale_ratio"], settings.min_depth, settings.max_depth)


def trained(run: Run, variant: str, seed: int) -> Trained:
    """`Trained`, one for the same weights and frames, so that tables that ask for the same scores compute them once."""
    return opened(Trained, (run, variant, seed), run.weights(variant, seed), run.prepared / "ground_truth.npz")


_made = functools.lru_cache(maxsize=256)(lambda kind, arguments, *changed: kind(*arguments))


def opened(kind: Callable[..., Any], arguments: tuple[Any, ...], *files: Path) -> Any:
    """`kind(*arguments)`, the same object as long as none of the files changes."""
    stats = [path.stat() if path.exists() else None for path in files]
    return _made(kind, arguments, *((s.st_size, s.st_mtime_ns) if s else None for s in stats))


def untrained_net(run: Run, seed: int) -> DepthModel:
    """LR-Net of a seed before its first step: what the architecture alone gives."""
    torch.manual_seed(seed)
    training = run.profile.training
    architecture = Architecture(network="lr", encoder=training.encoder)
    card = architecture.model_dump() | {"hr_size": run.profile.data.hr_size}
    return DepthModel(card, architecture.build(training.pretrained), device=default_device(), precision="float32")


SEEDLESS = -1  # Stands for the seed of a method that knows none, such as a baseline.


class Scores(NamedTuple):
    """Scores of several methods in one long frame, and why others have none."""

    frame: pd.DataFrame  # Metrics, a row per (variant, seed, image), or per (variant, seed, image, part).
    trainings: dict[str, list[Trained]]  # Of each variant that was trained: one for each seed.
    missing: dict[str, str]  # Of each variant without scores: the reason.
    drives: Sequence[str] = ()  # Drives of the frames that are scored.
    notes: Mapping[str, str] = {}  # Of each method that is no training: what it is.

    @property
    def weights(self) -> list[Path]:
        """Files of all trainings, for a table's stamp."""
        return [training.weights for of_seeds in self.trainings.values() for training in of_seeds]

    def of(self, variant: str, part: str | None = None) -> pd.DataFrame:
        """The rows (seed, image) of a variant, of one part of the images where they have parts; images without that part have no row."""
        there = variant in self.frame.index.unique("variant")
        frame = self.frame.loc[variant] if there else self.frame.iloc[:0].droplevel("variant")
        return frame if part is None else frame[frame.index.get_level_values("part") == part].droplevel("part")

    def plus(self, name: str, frames: dict[int, pd.DataFrame] | None, note: str) -> "Scores":
        """With another method: its scores by seed, or under `SEEDLESS`, and what it is; None where it has none, and `note` says why."""
        if frames is None:
            return self._replace(missing=self.missing | {name: note}, notes={**self.notes, name: note})
        more = pd.concat({(name, seed): frame for seed, frame in frames.items()}, names=["variant", "seed"])
        return self._replace(frame=pd.concat([self.frame, more]), notes={**self.notes, name: note})


def collect(
    run: Run,
    variants: Iterable[str],
    seeds: Sequence[int],
    score: Callable[[Trained], pd.DataFrame] = lambda training: training.scores,
    *,
    reason: str | None = None,
    drives: Sequence[str] | None = None,
) -> Scores:
    """Scores of trainings, of every seed; variants that the profile does not train go to `missing`.

    `score` gives the rows of a training, by image, or by (image, part). `reason` is why nothing can be scored, or empty; None asks whether
    the run's frames have a ground truth. `drives` are those of the scored images, for the guard against leaks; None means the depth
    tables'.
    """
    if reason is None:
        reason = "" if run.profile.data.has_truth else NO_TRUTH
    missing = {v: reason or f"profile {run.profile.name} does not train {v}" for v in variants if reason or v not in run.profile.train}
    trainings = {v: [trained(run, v, seed) for seed in seeds] for v in variants if v not in missing}
    frames = {(v, training.seed): score(training) for v, found in trainings.items() for training in found}
    frame = pd.concat(frames, names=["variant", "seed"]) if frames else pd.DataFrame()
    return Scores(frame, trainings, missing, drives if drives is not None or reason else scored(run).drives)
