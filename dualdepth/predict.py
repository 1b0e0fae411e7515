"""From images to disparities with trained weights."""

from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import torch
from torch import nn
from tqdm import tqdm

from dualdepth.checkpoints import load_card, load_weights
from dualdepth.data.augmentation import resize
from dualdepth.data.kitti import read_image
from dualdepth.data.loading import low_resolution, to_unit
from dualdepth.errors import InputError
from dualdepth.networks.lr_net import LRNet


def load_depth_net(weights: str | Path) -> tuple[nn.Module, tuple[int, int]]:
    """The depth network of a training, in eval mode, and its HR size (height, width).

    Raises:
        InputError: the weights or their card cannot be read or do not fit.
    """
    network = load_card(weights).get("network")
    try:
        net, size = LRNet(network["encoder"]), tuple(network["hr_size"])
    except (KeyError, TypeError) as error:
        raise InputError(
            f"{Path(weights).with_suffix('.json')}: names no network ({error!r}); keep the card that was written with it"
        ) from None
    load_weights(weights, net, prefix="depth_net.")
    return net.eval(), size


@torch.inference_mode()
def predict_disparities(
    net: nn.Module, paths: Sequence[str | Path], hr_size: tuple[int, int], *, device: str | torch.device = "cpu", batch_size: int = 4
) -> np.ndarray:
    """Disparities of image files, at the network's own size.

    The whole frame is resized to `hr_size`; LR-Net sees it averaged 3×3, as in training.

    Returns:
        (N, h, w) float32, positive, of unknown scale.
    """
    net = net.to(device)
    maps = []
    with tqdm(total=len(paths), desc="predicting", unit="image") as bar:
        for batch in _batches(paths, batch_size):
            frames = np.stack([resize(read_image(path), hr_size) for path in batch]).transpose(0, 3, 1, 2)
            images = low_resolution(to_unit(torch.from_numpy(np.ascontiguousarray(frames)))[:, None])[:, 0]
            maps.append(net(images.to(device), scales=1).disparities[0][:, 0].float().cpu().numpy())
            bar.update(len(batch))
    return np.concatenate(maps)


def _batches(paths: Sequence[str | Path], size: int) -> Iterable[Sequence[str | Path]]:
    return (paths[i : i + size] for i in range(0, len(paths), size))
