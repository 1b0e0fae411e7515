"""From images to disparities with trained weights."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from dualdepth.data.frames import resample
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.geometry import low_resolution, pose_matrix, to_unit
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.pose_net import PoseNet
from dualdepth.training.weights import load_card, load_weights

LARGEST_FRAME = 10**8
"""Pixels of a frame that a card may announce."""


class DepthNet(NamedTuple):
    """A depth network in eval mode and what it expects."""

    net: nn.Module
    architecture: Architecture
    hr_size: tuple[int, int]
    """(height, width) that frames are resized to; LR-Net sees a third of it."""


def load_depth_net(weights: str | Path) -> DepthNet:
    """The depth network of a training.

    Raises:
        InputError: the weights or their card cannot be read or do not fit.
    """
    card = load_card(weights)
    try:
        architecture = Architecture.of_card({name: card[name] for name in Architecture.model_fields})  # a training's card has them all
    except (KeyError, TypeError, ValueError) as error:
        raise _foreign_card(weights, error) from None
    net = architecture.build()
    load_weights(weights, net, prefix="depth_net.")
    return DepthNet(net.eval(), architecture, _frame_size(weights, card))


def disparities_of(depth_net: DepthNet, images: Sequence[np.ndarray], device: str | torch.device) -> np.ndarray:
    """Disparities of images (H, W, 3) uint8 RGB of any sizes, computed together by a network on `device`; see `predict_disparities`."""
    frames = np.stack([resample(image, depth_net.hr_size) for image in images]).transpose(0, 3, 1, 2)
    seen = to_unit(torch.from_numpy(np.ascontiguousarray(frames)).to(device))
    if depth_net.architecture.sees_low_resolution:
        seen = low_resolution(seen[:, None])[:, 0]
    return depth_net.net(seen, scales=1).disparities[0][:, 0].float().cpu().numpy()


@torch.inference_mode()
def predict_disparities(
    depth_net: DepthNet,
    paths: Sequence[str | Path],
    *,
    device: str | torch.device = "cpu",
    batch_size: int = 4,
    read: Callable[[str | Path], np.ndarray] = read_image,
) -> np.ndarray:
    """Disparities of image files, at the network's own size.

    What `read` gives of a file, (H, W, 3) uint8 RGB, is resized to the HR size; LR-Net sees that averaged 3×3, as in training.

    Returns:
        (N, h, w) float32, positive, of unknown scale.
    """
    depth_net.net.to(device)
    maps = []
    with tqdm(total=len(paths), desc="predicting", unit="image") as bar:
        for start in range(0, len(paths), batch_size):
            images = [read(path) for path in paths[start : start + batch_size]]
            maps.append(disparities_of(depth_net, images, device))
            bar.update(len(images))
    return np.concatenate(maps)


class PoseModel(NamedTuple):
    """A PoseNet in eval mode and the size of the frames that it expects."""

    net: PoseNet
    hr_size: tuple[int, int]


def load_pose_net(weights: str | Path) -> PoseModel:
    """The PoseNet of a training.

    Raises:
        InputError: the weights or their card cannot be read or do not fit.
    """
    net = PoseNet()
    card = load_weights(weights, net, prefix="pose_net.")
    return PoseModel(net.eval(), _frame_size(weights, card))


@torch.inference_mode()
def predict_poses(model: PoseModel, paths: Sequence[str | Path], *, device: str | torch.device = "cpu", batch_size: int = 16) -> np.ndarray:
    """Motions between the neighbouring frames of a sequence; each frame is decoded once.

    Args:
        model: from `load_pose_net`.
        paths: N ≥ 3 consecutive frames.
        device: where to compute.
        batch_size: targets at a time.

    Returns:
        (N − 2, 2, 4, 4) float64: for each frame but the first and last, as target, the pose that maps its coordinates to the previous
        frame's and to the next frame's; translations in units of the predicted depth.

    Raises:
        InputError: fewer than three frames.
    """
    if len(paths) < 3:
        raise InputError(f"{len(paths)} frames: PoseNet sees three at a time")
    net, hr_size = model.net.to(device), model.hr_size
    frames: list[torch.Tensor] = []
    poses = []
    with tqdm(total=len(paths), desc="predicting poses", unit="image") as bar:
        for number, path in enumerate(paths, 1):
            image = to_unit(torch.from_numpy(resample(read_image(path), hr_size).transpose(2, 0, 1).copy()))
            frames.append(low_resolution(image[None, None])[0, 0])
            if len(frames) == batch_size + 2 or number == len(paths):
                views = [torch.stack([frames[i], frames[i - 1], frames[i + 1]]) for i in range(1, len(frames) - 1)]
                if views:
                    poses.append(pose_matrix(net(torch.stack(views).to(device)).double()).cpu())
                frames = frames[-2:]
            bar.update()
    return torch.cat(poses).numpy()


def _frame_size(weights: str | Path, card: dict[str, Any]) -> tuple[int, int]:
    match card.get("hr_size"):
        case [int(height), int(width)] if min(height, width) >= 3 and height * width <= LARGEST_FRAME:
            return height, width
    raise _foreign_card(weights, f"hr_size {card.get('hr_size')!r} is no (height, width) in pixels")


def _foreign_card(weights: str | Path, reason: object) -> InputError:
    card = Path(weights).with_suffix(".json")
    return InputError(f"{card}: names no network of this project ({reason}); keep the card that was written with it")
