"""PoseNet of Zhou et al. 2017 (SfMLearner `nets.py`), as the paper uses it, and one with an encoder, beyond the paper."""

import torch
from torch import Tensor, nn

from dualdepth.geometry import inverse_pose
from dualdepth.networks import PoseEncoder
from dualdepth.networks.encoders import make_encoder

POSE_SCALE = 0.1
"""Zhou et al. have 0.01, beside disparities of mean 10; ours have mean 1, where a translation of the same pixels is ten times as large. Of
0.03 to 1 the smallest learned more slowly (docs/learning.md)."""
DIFFERENCES = 4.0
"""At the start the first layer sees the sources less the target, so many times enlarged, beside the target: motion is what differs."""


class PoseNet(nn.Module):
    """Target and source images → one pose per source, each mapping target coordinates to source coordinates.

    Seven stride-2 convolutions with ReLU, no batch norm, a linear 1×1 convolution, the spatial mean, × 0.1.
    Zero padding, since its deepest maps are too small to reflect. It begins with He's initialisation, which keeps the signal down the seven
    layers (Xavier's, as in Zhou et al., leaves a fiftieth of it), with a first layer that looks at differences of the images, and with a
    last layer at zero, so that the first poses are the identity.
    """

    def __init__(self) -> None:
        super().__init__()
        widths, kernels = (16, 32, 64, 128, 256, 256, 256), (7, 5, 3, 3, 3, 3, 3)
        layers: list[nn.Module] = []
        inputs = 3 * 3  # target and two sources
        for width, kernel in zip(widths, kernels):
            layers += [nn.Conv2d(inputs, width, kernel, stride=2, padding=kernel // 2), nn.ReLU()]
            inputs = width
        self.layers = nn.Sequential(*layers, nn.Conv2d(inputs, 6 * 2, 1))
        for layer in self.layers:
            if isinstance(layer, nn.Conv2d):
                nn.init.kaiming_uniform_(layer.weight, nonlinearity="relu")
                nn.init.zeros_(layer.bias)
        nn.init.zeros_(self.layers[-1].weight)
        with torch.no_grad():
            target, *others = self.layers[0].weight.split(3, dim=1)
            for source in others:
                source *= DIFFERENCES
                target -= source

    def forward(self, images: Tensor) -> Tensor:
        """Poses (B, 2, 6) of images (B, 3, 3, H, W) in [0, 1], target first.

        Order tx, ty, tz, rx, ry, rz; translations in units of the predicted depth, angles in radians.
        """
        x = 2.0 * images.flatten(1, 2) - 1.0
        poses = self.layers(x).float().mean(dim=(2, 3))
        return POSE_SCALE * torch.unflatten(poses, 1, (2, 6))


class EncoderPoseNet(nn.Module):
    """Beyond the paper: an encoder that sees two images, and the four convolutions of Godard et al. 2019 (`pose_decoder.py`) behind it.

    It takes what `PoseNet` takes, and gives what it gives. It sees each pair in the order of time, previous and target, target and next,
    so that it learns one direction of motion; the pose to the previous frame is the inverse of what it finds.

    Args:
        encoder, pretrained: as of `encoders.make_encoder`; the first layer's weights for three channels, halved, serve both images.
    """

    def __init__(self, encoder: str, pretrained: bool | str = False) -> None:
        super().__init__()
        self.encoder = make_encoder(encoder, pretrained)
        first = next(layer for layer in self.encoder.modules() if isinstance(layer, nn.Conv2d))
        first.weight, first.in_channels = nn.Parameter(first.weight.detach().repeat(1, 2, 1, 1) / 2), 6
        self.encoder.mean, self.encoder.std = (values.repeat(1, 2, 1, 1) for values in (self.encoder.mean, self.encoder.std))
        layers: list[nn.Module] = [nn.Conv2d(self.encoder.channels[-1], 256, 1)]
        for _ in range(2):
            layers += [nn.ReLU(), nn.Conv2d(256, 256, 3, padding=1)]
        self.layers = nn.Sequential(*layers, nn.ReLU(), nn.Conv2d(256, 6, 1))

    def forward(self, images: Tensor) -> Tensor:
        """Poses (B, 2, 6) of images (B, 3, 3, H, W) in [0, 1]: target, previous, next; see `PoseNet.forward`."""
        pairs = torch.cat([images[:, [1, 0]], images[:, [0, 2]]]).flatten(1, 2)
        to_target, to_next = (POSE_SCALE * self.layers(self.encoder(pairs)[-1]).float().mean(dim=(2, 3))).chunk(2)
        with torch.autocast(images.device.type, enabled=False):
            return torch.stack([inverse_pose(to_target), to_next], dim=1)


def make_pose_net(encoder: PoseEncoder | None, pretrained: bool | str = False) -> PoseNet | EncoderPoseNet:
    """The paper's PoseNet, or one with an encoder."""
    return EncoderPoseNet(encoder, pretrained) if encoder else PoseNet()
