"""The decoder that all depth networks share; a declared reconstruction, since the paper's supplement is not public.

Its widths were fitted to the six numbers of the paper's overhead table.
"""

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

WIDTHS = (256, 128, 64, 32, 16)
"""Channels from stride 16 to stride 1."""
MAX_NECK = 512
DISPARITY_SCALE, DISPARITY_OFFSET = 10.0, 0.01
"""Disparity = 10 · sigmoid + 0.01 (SfMLearner), so that it lies in (0.01, 10.01)."""


class DepthOutput(NamedTuple):
    """What a depth network gives: disparities (B, 1, H/2^s, W/2^s) for s = 0 … 3, and the last features (B, 16, H, W)."""

    disparities: list[Tensor]
    features: Tensor


def conv3x3(inputs: int, outputs: int) -> nn.Conv2d:
    """3×3 convolution with bias and reflection padding."""
    return nn.Conv2d(inputs, outputs, 3, padding=1, padding_mode="reflect")


class Decoder(nn.Module):
    """Features at strides 2 … 32 → disparities at 1/1, 1/2, 1/4, 1/8 of the input size.

    Args:
        channels: of the maps at strides 2, 4, 8, 16, 32; None where there is no stride-2 map.
    """

    def __init__(self, channels: Sequence[int | None]) -> None:
        super().__init__()
        *lateral_channels, deepest = channels
        width = min(deepest, MAX_NECK)
        squeeze = [nn.Conv2d(deepest, MAX_NECK, 1), nn.ELU()] if deepest > MAX_NECK else []
        self.neck = nn.Sequential(*squeeze, conv3x3(width, width), nn.ELU(), nn.Conv2d(width, WIDTHS[0], 1), nn.ELU())
        inputs = (WIDTHS[0], *WIDTHS[:-1])
        self.up = nn.ModuleList(conv3x3(i, o) for i, o in zip(inputs, WIDTHS))
        laterals = [*reversed(lateral_channels), None]  # the full resolution has no encoder map
        self.lateral = nn.ModuleList(nn.Conv2d(c, w, 1) if c else nn.Identity() for c, w in zip(laterals, WIDTHS))
        self.has_lateral = [c is not None for c in laterals]
        self.merge = nn.ModuleList(nn.Sequential(conv3x3(w, w), nn.ELU(), conv3x3(w, w), nn.ELU()) for w in WIDTHS)
        self.heads = nn.ModuleList(conv3x3(w, 1) for w in WIDTHS[1:])

    def forward(self, maps: Sequence[Tensor | None], scales: int = 4) -> DepthOutput:
        """Decode the encoder's five maps (finest first); `scales` heads are run, from the finest on."""
        *finer, x = maps
        x = self.neck(x)
        disparities: list[Tensor] = []
        for level, skip in enumerate([*reversed(finer), None]):
            x = F.interpolate(F.elu(self.up[level](x)), scale_factor=2, mode="nearest")
            if self.has_lateral[level]:
                x = x + self.lateral[level](skip)
            x = self.merge[level](x)
            if level > 0 and len(WIDTHS) - level <= scales:
                logits = self.heads[level - 1](x).float()  # bf16 cannot tell neighbouring depths apart
                disparities.insert(0, DISPARITY_SCALE * torch.sigmoid(logits) + DISPARITY_OFFSET)
        return DepthOutput(disparities, x)
