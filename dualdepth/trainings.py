"""Trains a variant of a profile: what it starts from, its network, its card."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dualdepth import ranks
from dualdepth.atomic import check_writable, write_text
from dualdepth.building import architecture, check_start, make_stage
from dualdepth.checkpoints import finished_card, load_card
from dualdepth.config import Profile
from dualdepth.data.odometry import drives_of, load_odometry_triplets
from dualdepth.data.triplets import Triplet, load_triplets, read_targets
from dualdepth.errors import InputError
from dualdepth.lock import locked
from dualdepth.memory import keep_freed_memory
from dualdepth.preparation import Sources
from dualdepth.results import Run
from dualdepth.sections import Variant
from dualdepth.training import train

PATIENCE = 15.0
"""Seconds that a training waits for the one before it, which may have been told to stop, or be left behind by a killed chain."""


def train_variant(run: Run, name: str, seed: int) -> Path:
    """Train a variant, or go on with it, or find it done; returns its weights.

    Nothing else trains the same variant and seed meanwhile; of several processes that train together the first holds the lock.

    Raises:
        InputError: an unknown variant; prepared data or stage 1's weights are missing, or those are of another network; too few
            triplets; a bad frame; a live process trains the same.
    """
    keep_freed_memory()
    variant, profile = run.profile.variant(name), run.profile.of_variant(name)
    triplets, drives = training_data(run, name)
    start = start_weights(run, variant, seed)
    if start:
        check_start(start, profile, variant)
    folder, weights, recipe = run.training(name, seed), run.weights(name, seed), run.recipe(name, seed)
    with _alone(folder):
        if (card := finished_card(weights)) and card.get("recipe") == recipe:
            if ranks.is_main():
                print(f"already trained: {card['steps']} steps, seed {seed}")
            return _mark(weights)
        train(
            lambda settings: make_stage(settings, variant, start),
            getattr(profile.training, variant.stage),
            profile,
            triplets,
            folder,
            seed=seed,
            recipe=recipe,
            card=_card(run, name, profile, len(triplets), drives, start),
        )
        return _mark(weights)


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Hold the lock of a training's folder; the other processes wait for the first one to have it, before anything is read."""
    with contextlib.ExitStack() as held:
        if ranks.is_main():
            check_writable(folder)
            held.enter_context(locked(folder / "lock", PATIENCE))
        ranks.wait_for_all()
        yield


def training_data(run: Run, name: str) -> tuple[list[Triplet], list[str]]:
    """Prepared triplets of a variant, and the drives that they are of.

    Raises:
        InputError: they are not prepared, or there are no odometry sequences.
    """
    sources, odometry = Sources.load(run), run.profile.variant(name).trains_on == "odometry"
    if odometry and sources.odometry_root is None:
        raise InputError(f"variant {name} needs ODOMETRY_ROOT; get it with python data_scripts/download_kitti.py --root DIR --odometry")
    index = run.require(run.index(name), "02_prepare_data")
    if not odometry:
        return load_triplets(index, sources.kitti_root), sorted({frame.drive for frame, _ in read_targets(index)})
    triplets, sequences = load_odometry_triplets(index, sources.odometry_root)
    return triplets, drives_of(sequences, world=run.profile.world is not None)


def start_weights(run: Run, variant: Variant, seed: int) -> Path | None:
    """Weights of stage 1 that a variant starts from, None where it starts from nothing.

    Raises:
        InputError: they are not there.
    """
    if variant.starts_from is None:
        return None
    return run.require(run.weights(variant.starts_from, seed), f"03_train_lr, variant {variant.starts_from}, seed {seed},")


def _pretrained(variant: Variant, profile: Profile, before: dict[str, Any] | None) -> bool:
    """Whether the encoder began with ImageNet's weights, here or in stage 1."""
    if variant.network == "hr":
        return False
    return before["pretrained"] if before else bool(profile.training.pretrained)


def _mark(weights: Path) -> Path:
    """Write `trained.json`, which tells the chain that these weights are done; the weights themselves are never the chain's to delete."""
    marker = weights.with_name("trained.json")
    if not ranks.is_main():
        return weights
    digest = json.dumps({"weights_sha256": load_card(weights)["sha256"]}) + "\n"
    if not marker.exists() or marker.read_text(encoding="utf-8") != digest:
        write_text(marker, digest)
    return weights


def _card(run: Run, name: str, profile: Profile, triplets: int, drives: list[str], start: Path | None) -> dict[str, Any]:
    variant = run.profile.variant(name)
    before = load_card(start) if start else None
    return {
        "variant": name,
        "about": f"{variant.about}, trained on {triplets} triplets: {run.profile.about}",
        **architecture(variant, profile).words(),
        "hr_size": list(profile.data.hr_size),
        "pretrained": _pretrained(variant, profile, before),
        "drives": sorted(set(drives) | set(before["drives"] if before else ())),
        "starts_from": {k: before[k] for k in ("variant", "seed", "steps", "sha256")} if before else None,
        "stamp": run.stamp([run.index(name), *([start] if start else [])]),
    }
