"""From images to disparities with trained weights."""

from collections.abc import Callable, Iterable, Sequence
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
        size = _frame_size(card["hr_size"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{Path(weights).with_suffix('.json')}: names no network of this project ({error}); keep the card that was written with it"
        ) from None
    net = architecture.build()
    load_weights(weights, net, prefix="depth_net.")
    return DepthNet(net.eval(), architecture, size)


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
    net, architecture, hr_size = depth_net
    net = net.to(device)
    maps = []
    with tqdm(total=len(paths), desc="predicting", unit="image") as bar:
        for batch in _batches(paths, batch_size):
            frames = np.stack([resample(read(path), hr_size) for path in batch]).transpose(0, 3, 1, 2)
            images = to_unit(torch.from_numpy(np.ascontiguousarray(frames)))
            if architecture.sees_low_resolution:
                images = low_resolution(images[:, None])[:, 0]
            maps.append(net(images.to(device), scales=1).disparities[0][:, 0].float().cpu().numpy())
            bar.update(len(batch))
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
    card, net = load_card(weights), PoseNet()
    try:
        size = _frame_size(card["hr_size"])
    except (KeyError, ValueError) as error:
        raise InputError(
            f"{Path(weights).with_suffix('.json')}: names no frame size ({error}); keep the card that was written with it"
        ) from None
    load_weights(weights, net, prefix="pose_net.")
    return PoseModel(net.eval(), size)


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


def _frame_size(value: Any) -> tuple[int, int]:
    match value:
        case [int(height), int(width)] if min(height, width) >= 3 and height * width <= LARGEST_FRAME:
            return height, width
    raise ValueError(f"hr_size {value!r} is no (height, width) in pixels")


def _batches(paths: Sequence[str | Path], size: int) -> Iterable[Sequence[str | Path]]:
    return (paths[i : i + size] for i in range(0, len(paths), size))
