"""What a variant of a profile trains: its triplets, the stage-1 weights that it starts from, its network inside a stage, its card."""

import contextlib
import json
from pathlib import Path

from torch import nn

from dualdepth.data.odometry import drives_of
from dualdepth.data.triplets import Triplet, load_triplets
from dualdepth.device import is_main_process, keep_freed_memory, wait_for_everyone
from dualdepth.errors import InputError
from dualdepth.files import check_writable, locked, write_text
from dualdepth.networks.pose_net import make_pose_net
from dualdepth.profile import Profile
from dualdepth.run import Run, Sources
from dualdepth.training.checkpoints import checkpoint_paths
from dualdepth.training.loop import Trainer
from dualdepth.training.stages import Stage
from dualdepth.training.weights import finished_card, load_card, load_weights

BASES = {True: "ImageNet's weights", False: "random weights"}
PATIENCE = 15.0
"""Seconds that a training waits for the one before it, which may have been told to stop, or be left behind by a killed chain."""


def train_variant(run: Run, name: str, seed: int) -> Path:
    """Train a variant, or go on with it, or find it done; returns its weights.

    Nothing else trains the same variant and seed meanwhile; of several processes that train together the first holds the lock.
    An `InputError` says that the variant is unknown, that prepared data or stage 1's weights are missing or of another network, that there
    are too few triplets or a bad frame, or that a live process trains the same.
    """
    keep_freed_memory()
    variant, profile = run.profile.variant(name), run.profile.of_variant(name)
    triplets, drives = training_data(run, name)
    start = start_weights(run, name, seed)
    folder, weights, recipe = run.training(name, seed), run.weights(name, seed), run.recipe(name, seed)
    with contextlib.ExitStack() as held:
        if is_main_process():
            check_writable(folder)
            held.enter_context(locked(folder / "lock", PATIENCE))
        wait_for_everyone()  # the first one has the lock before anything is read
        if (card := finished_card(weights)) and card.get("recipe") == recipe:
            if is_main_process():
                print(f"already trained: {card['steps']} steps, seed {seed}")
            return _mark(weights)
        settings, pretrained = getattr(profile.training, variant.stage), profile.training.pretrained
        if is_main_process():
            base = f"after stage 1 ({variant.starts_from})" if start else f"starting from {BASES.get(pretrained, pretrained)}"
            print(f"{name}, seed {seed}: {variant.label}, {base}", flush=True)
        trainer = Trainer(lambda: make_stage(run.profile, name, start), settings, profile, triplets, folder, seed=seed, recipe=recipe)
        before = load_card(start) if start else None
        card = {
            "variant": name,
            "about": f"{variant.about}, trained on {len(triplets)} triplets: {run.profile.about}",
            **run.profile.architecture(name).model_dump(),
            "hr_size": list(profile.data.hr_size),
            # whether the encoder began with ImageNet's weights, here or in stage 1
            "pretrained": variant.network != "hr" and (before["pretrained"] if before else bool(pretrained)),
            "drives": sorted(set(drives) | set(before["drives"] if before else ())),
            "pose_encoder": profile.training.beyond_paper_pose_encoder,
            "frozen_pose": bool(start) and profile.training.hr.beyond_paper_frozen_pose,
            "refined": trainer.total > trainer.unrefined_steps,
            "anchored": run.profile.architecture(name).residual and profile.training.beyond_paper_residual_anchor > 0,
            "mean_disparity": profile.training.loss.mean_disparity,
            "average": profile.training.beyond_paper_average,
            "starts_from": {k: before[k] for k in ("variant", "seed", "steps", "sha256")} if before else None,
            "stamp": run.stamp([run.index(name), *([start] if start else [])]),
        }
        return _mark(trainer.run(card))


def training_data(run: Run, name: str) -> tuple[list[Triplet], list[str]]:
    """Prepared triplets of a variant, and the drives that they are of. An `InputError` says that they are not prepared, or that
    there are no odometry sequences."""
    sources, odometry = Sources.load(run), run.profile.variant(name).trains_on == "odometry"
    if odometry and sources.odometry_root is None:
        raise InputError(f"variant {name} needs ODOMETRY_ROOT; get it with python data_scripts/download_kitti.py --root DIR --odometry")
    index = run.require(run.index(name), "02_prepare_data")
    triplets = load_triplets(index, sources.odometry_root if odometry else sources.kitti_root)
    drives = sorted({triplet.drive for triplet in triplets})
    return triplets, drives_of(drives, world=run.profile.world is not None) if odometry else drives


def start_weights(run: Run, name: str, seed: int) -> Path | None:
    """Weights of stage 1 that a variant starts from, None where it starts from nothing. An `InputError` says that they are not there,
    that their card is incomplete, or that they are of another network, backbone or size."""
    first, profile = run.profile.variant(name).starts_from, run.profile.of_variant(name)
    if first is None:
        return None
    start = run.require(run.weights(first, seed), f"03_train_lr, variant {first}, seed {seed},")
    card = load_card(start)
    needed = {"network": "lr", "encoder": profile.training.encoder, "hr_size": list(profile.data.hr_size)}
    needed["pose_encoder"] = profile.training.beyond_paper_pose_encoder
    wrong = [f"{key} {card.get(key)!r} instead of {value!r}" for key, value in needed.items() if card.get(key) != value]
    wrong += [f"no {key}" for key in ("variant", "seed", "steps", "sha256", "drives", "pretrained") if key not in card]
    if wrong:
        raise InputError(f"{start}: its card has {', '.join(wrong)}; train {first} again with this profile")
    return start


def make_stage(profile: Profile, name: str, start: Path | None = None) -> Stage:
    """The stage that a variant trains, with stage 1's LR-Net and PoseNet in it where it starts from them.
    An `InputError` says that the weights are damaged or of another network."""
    variant, training = profile.variant(name), profile.of_variant(name).training
    # a dual network's LR-Net has the weights of `start`: only a first training begins with ImageNet's
    depth_net = profile.architecture(name).build(training.pretrained if variant.network in ("lr", "single") else False)
    # a place of weights that is named is the depth encoder's
    pretrained = training.pretrained if training.beyond_paper_pose_encoder == training.encoder else bool(training.pretrained)
    pose_net = make_pose_net(training.beyond_paper_pose_encoder, pretrained if not start else False)
    stage = Stage(depth_net, pose_net, training, low=variant.network == "lr")
    if profile.architecture(name).residual:
        depth_net.floor.fill_(training.beyond_paper_residual_floor)
        for head in depth_net.hr_net.decoder.heads:
            nn.init.zeros_(head.weight)
    if start:
        stage.corridor_steps = 0  # PoseNet has learned to turn
        stage.pose_net.requires_grad_(not training.hr.beyond_paper_frozen_pose)
        load_weights(start, stage.pose_net, prefix="pose_net.")
        if variant.network == "dual":
            load_weights(start, stage.depth_net.lr_net, prefix="depth_net.")
    return stage


def _mark(weights: Path) -> Path:
    """Write `trained.json`, which tells the chain that these weights are done (they are never its to delete); remove the checkpoints."""
    marker = weights.with_name("trained.json")
    digest = json.dumps({"weights_sha256": load_card(weights)["sha256"]}) + "\n"
    if is_main_process():
        for path in (*checkpoint_paths(weights.parent), *weights.parent.glob(".trained.*.part.json")):  # the latter a killed writer's
            path.unlink(missing_ok=True)
        if not (marker.exists() and marker.read_text(encoding="utf-8") == digest):
            write_text(marker, digest)
    return weights
