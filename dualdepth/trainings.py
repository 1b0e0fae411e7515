"""Trains a variant of a profile: what it starts from, its network, its card."""

import json
from pathlib import Path
from typing import Any

from torch import nn

from dualdepth.atomic import write_text
from dualdepth.checkpoints import load_card, load_weights
from dualdepth.config import Profile
from dualdepth.data.triplets import load_triplets, read_targets
from dualdepth.errors import InputError
from dualdepth.hr_stage import HRStage
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.pose_net import PoseNet
from dualdepth.preparation import Sources
from dualdepth.results import Run
from dualdepth.sections import Variant
from dualdepth.stages import LRStage
from dualdepth.training import train


def train_variant(run: Run, name: str, seed: int) -> Path:
    """Train a variant, or go on with it, or find it done; returns its weights.

    Raises:
        InputError: an unknown variant; prepared data or stage 1's weights are missing, or those are of another network; too few
            triplets; a bad frame.
    """
    variant, profile = run.profile.variant(name), run.profile.of_variant(name)
    index = run.require(run.prepared / "triplets.csv", "02_prepare_data")
    start = start_weights(run, variant, seed)
    weights, recipe = run.weights(name, seed), run.recipe(name, seed)
    if weights.exists() and (card := load_card(weights)).get("recipe") == recipe:
        print(f"already trained: {card['steps']} steps, seed {seed}")
        return _mark(weights)
    train(
        lambda settings: make_stage(settings, variant, start),
        getattr(profile.training, variant.stage),
        profile,
        load_triplets(index, Sources.load(run).kitti_root),
        run.training(name, seed),
        seed=seed,
        recipe=recipe,
        card=_card(run, name, profile, index, start),
    )
    return _mark(weights)


def start_weights(run: Run, variant: Variant, seed: int) -> Path | None:
    """Weights of stage 1 that a variant starts from, None where it starts from nothing.

    Raises:
        InputError: they are not there.
    """
    if variant.starts_from is None:
        return None
    return run.require(run.weights(variant.starts_from, seed), f"03_train_lr, variant {variant.starts_from}, seed {seed},")


def architecture(variant: Variant, profile: Profile) -> Architecture:
    """The depth network of a variant."""
    return Architecture(variant.network, profile.training.encoder, variant.link, variant.similarity, variant.normalise)


def make_stage(profile: Profile, variant: Variant, start: Path | None = None) -> nn.Module:
    """The stage a variant trains, with stage 1's LR-Net and PoseNet in it where it starts from them.

    Args:
        profile: with the variant's settings in it.
        variant: what to build.
        start: weights of stage 1.

    Raises:
        InputError: the weights are of another size or backbone, damaged, or not of stage 1.
    """
    if variant.network == "lr":
        return LRStage(profile)
    # LR-Net's weights, if it has any, are those of `start`: only a single network begins with ImageNet's
    pretrained = profile.training.pretrained if variant.network == "single" else False
    stage = HRStage(profile, architecture(variant, profile).build(pretrained), PoseNet())
    if start:
        _check_start(start, profile, variant)
        load_weights(start, stage.pose_net, prefix="pose_net.")
        if variant.network == "dual":
            load_weights(start, stage.depth_net.lr_net, prefix="depth_net.")
    return stage


def _check_start(start: Path, profile: Profile, variant: Variant) -> None:
    card = load_card(start)
    found = (card.get("network"), card.get("encoder"), card.get("hr_size"))
    needed = ("lr", profile.training.encoder, list(profile.data.hr_size))
    if found != needed:
        said = [f"{name} {f!r} instead of {n!r}" for name, f, n in zip(("network", "encoder", "hr_size"), found, needed) if f != n]
        raise InputError(f"{start}: trained with {', '.join(said)}; train {variant.starts_from} again with this profile")


def _mark(weights: Path) -> Path:
    """Write `trained.json`, which tells the chain that these weights are done; the weights themselves are never the chain's to delete."""
    marker = weights.with_name("trained.json")
    digest = json.dumps({"weights_sha256": load_card(weights)["sha256"]}) + "\n"
    if not marker.exists() or marker.read_text(encoding="utf-8") != digest:
        write_text(marker, digest)
    return weights


def _card(run: Run, name: str, profile: Profile, index: Path, start: Path | None) -> dict[str, Any]:
    targets, variant = read_targets(index), run.profile.variant(name)
    before = load_card(start) if start else None
    return {
        "variant": name,
        "about": f"{variant.about}, trained on {len(targets)} triplets: {run.profile.about}",
        **architecture(variant, profile).words(),
        "hr_size": list(profile.data.hr_size),
        "pretrained": bool(profile.training.pretrained),
        "drives": sorted({frame.drive for frame, _ in targets} | set(before["drives"] if before else ())),
        "starts_from": {k: before[k] for k in ("variant", "seed", "sha256")} if before else None,
        "stamp": run.stamp([index, *([start] if start else [])]),
    }
