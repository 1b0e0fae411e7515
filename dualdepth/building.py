"""What a variant trains: its network inside a stage, with the weights of stage 1 that it starts from."""

from pathlib import Path

from torch import nn

from dualdepth.checkpoints import load_card, load_weights
from dualdepth.config import Profile
from dualdepth.errors import InputError
from dualdepth.hr_stage import HRStage
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.pose_net import PoseNet
from dualdepth.sections import Variant
from dualdepth.stages import LRStage


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
        check_start(start, profile, variant)
        load_weights(start, stage.pose_net, prefix="pose_net.")
        if variant.network == "dual":
            load_weights(start, stage.depth_net.lr_net, prefix="depth_net.")
    return stage


def check_start(start: Path, profile: Profile, variant: Variant) -> None:
    """Make sure that weights of stage 1 are what a variant can start from.

    Raises:
        InputError: their card is not of this project, or they are of another network, backbone or size.
    """
    card = load_card(start)
    missing = {"variant", "seed", "steps", "sha256", "drives", "pretrained"} - set(card)
    if missing and card.get("network") == "lr":
        raise InputError(f"{start}: its card has no {sorted(missing)[0]}; train {variant.starts_from} again")
    found = (card.get("network"), card.get("encoder"), card.get("hr_size"))
    needed = ("lr", profile.training.encoder, list(profile.data.hr_size))
    if found != needed:
        said = [f"{name} {f!r} instead of {n!r}" for name, f, n in zip(("network", "encoder", "hr_size"), found, needed) if f != n]
        raise InputError(f"{start}: trained with {', '.join(said)}; train {variant.starts_from} again with this profile")
