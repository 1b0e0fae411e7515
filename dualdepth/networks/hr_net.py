"""HR-Net: the slim network that sees the full resolution (paper, "Dual Network Architecture"); its widths are a declared reconstruction."""

import torch
from torch import Tensor, nn

from dualdepth.networks.decoder import Decoder, DepthOutput

WIDTHS = (32, 64, 128, 128, 128)
"""Channels at strides 2, 4, 8, 16, 32; fitted, like the decoder's, to the paper's overhead table."""


class HREncoder(nn.Module):
    """Five stages, each a 3×3 convolution of stride 2 and one of stride 1, with batch norm and ELU; reflection padding."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Sequential(*_block(inputs, outputs, 2), *_block(outputs, outputs, 1)) for inputs, outputs in zip((3, *WIDTHS), WIDTHS)
        )

    def forward(self, image: Tensor) -> list[Tensor]:
        """Maps at strides 2 … 32 of an image (B, 3, H, W) in [0, 1]; H and W multiples of 32."""
        maps, x = [], 2.0 * image - 1.0
        for stage in self.stages:
            x = stage(x)
            maps.append(x)
        return maps


class HRNet(nn.Module):
    """HR-Net's encoder and decoder, with room for global features at stride 32.

    Args:
        global_channels: of the features handed over by LR-Net; 0 for HR-Net by itself, which the paper says cannot work alone.
    """

    def __init__(self, global_channels: int = 0) -> None:
        super().__init__()
        self.encoder = HREncoder()
        self.decoder = Decoder((*WIDTHS[:-1], WIDTHS[-1] + global_channels))

    def forward(self, image: Tensor, scales: int = 4, global_features: Tensor | None = None) -> DepthOutput:
        """Disparities of an image (B, 3, H, W) in [0, 1], with global features (B, C, H/32, W/32) if it was built for them."""
        *finer, deepest = self.encoder(image)
        if global_features is not None:
            deepest = torch.cat([deepest, global_features.to(deepest.dtype)], dim=1)
        return self.decoder([*finer, deepest], scales)


def _block(inputs: int, outputs: int, stride: int) -> list[nn.Module]:
    conv = nn.Conv2d(inputs, outputs, 3, stride=stride, padding=1, padding_mode="reflect", bias=False)
    return [conv, nn.BatchNorm2d(outputs), nn.ELU()]
