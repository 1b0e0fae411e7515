"""PoseNet of Zhou et al. 2017 (SfMLearner `nets.py`), as the paper uses it."""

import torch
from torch import Tensor, nn

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

    def __init__(self, sources: int = 2) -> None:
        super().__init__()
        self.sources = sources
        widths, kernels = (16, 32, 64, 128, 256, 256, 256), (7, 5, 3, 3, 3, 3, 3)
        layers: list[nn.Module] = []
        inputs = 3 * (1 + sources)
        for width, kernel in zip(widths, kernels):
            layers += [nn.Conv2d(inputs, width, kernel, stride=2, padding=kernel // 2), nn.ReLU()]
            inputs = width
        self.layers = nn.Sequential(*layers, nn.Conv2d(inputs, 6 * sources, 1))
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
        """Poses (B, sources, 6) of images (B, 1 + sources, 3, H, W) in [0, 1], target first.

        Order tx, ty, tz, rx, ry, rz; translations in units of the predicted depth, angles in radians.
        """
        x = 2.0 * images.flatten(1, 2) - 1.0
        poses = self.layers(x).float().mean(dim=(2, 3))
        return POSE_SCALE * torch.unflatten(poses, 1, (self.sources, 6))
