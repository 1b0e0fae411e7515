"""The trainings a profile can ask for, by name."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from torch import nn

from dualdepth.atomic import write_text
from dualdepth.checkpoints import load_card
from dualdepth.config import Profile
from dualdepth.data.triplets import load_triplets, read_targets
from dualdepth.errors import InputError
from dualdepth.preparation import Sources
from dualdepth.results import Run
from dualdepth.stages import LRStage
from dualdepth.training import train


@dataclasses.dataclass(frozen=True)
class Variant:
    """What one training learns."""

    stage: str
    """Section of the profile's `training` with its epochs, batch and learning rates."""
    make_model: Callable[[Profile], nn.Module]
    about: str


VARIANTS = {"lr": Variant("lr", LRStage, "LR-Net with PoseNet (stage 1)")}


def train_variant(run: Run, variant: str, seed: int) -> Path:
    """Train a variant, or go on with it, or find it done; returns its weights.

    Raises:
        InputError: an unknown variant, prepared data missing, too few triplets, or a bad frame.
    """
    if variant not in VARIANTS:
        raise InputError(f"variant {variant!r} is unknown; there are {', '.join(VARIANTS)}")
    chosen = VARIANTS[variant]
    index = run.require(run.prepared / "triplets.csv", "02_prepare_data")
    weights, recipe = run.weights(variant, seed), run.recipe(chosen.stage)
    if weights.exists() and (card := load_card(weights)).get("recipe") == recipe:
        print(f"already trained: {card['steps']} steps, seed {seed}")
        return _mark(weights)
    train(
        chosen.make_model,
        getattr(run.profile.training, chosen.stage),
        run.profile,
        load_triplets(index, Sources.load(run).kitti_root),
        run.training(variant, seed),
        seed=seed,
        recipe=recipe,
        card=_card(run, variant, index),
    )
    return _mark(weights)


def _mark(weights: Path) -> Path:
    """Write `trained.json`, which tells the chain that these weights are done; the weights themselves are never the chain's to delete."""
    marker = weights.with_name("trained.json")
    digest = json.dumps({"weights_sha256": load_card(weights)["sha256"]}) + "\n"
    if not marker.exists() or marker.read_text(encoding="utf-8") != digest:
        write_text(marker, digest)
    return weights


def _card(run: Run, variant: str, index: Path) -> dict[str, Any]:
    targets = read_targets(index)
    return {
        "variant": variant,
        "about": f"{VARIANTS[variant].about}, trained on {len(targets)} triplets: {run.profile.about}",
        "network": {"encoder": run.profile.training.encoder, "hr_size": list(run.profile.data.hr_size)},
        "drives": sorted({frame.drive for frame, _ in targets}),
        "stamp": run.stamp([index]),
    }
