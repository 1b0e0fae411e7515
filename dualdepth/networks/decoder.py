"""The decoder that all depth networks share; a declared reconstruction, since the paper's supplement is not public.

Its widths were fitted to the six numbers of the paper's overhead table.
"""

import contextlib
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.networks.convolution import conv3x3

WIDTHS = (256, 128, 64, 32, 16)  # Channels from stride 16 to stride 1.
MAX_NECK = 512
START_LOGIT = -5.0
"""Of every pixel before the first step, disparity 0.077: there is room for 130 times as much, and for depth eight times as far. Losses see
only ratios, so the mean stays there. From the middle of the sigmoid nothing can be more than twice as near as the mean."""
DISPARITY_SCALE, DISPARITY_OFFSET = 10.0, 0.01  # Disparity = 10 · sigmoid + 0.01 (SfMLearner), so that it lies in (0.01, 10.01).


class DepthOutput(NamedTuple):
    """What a depth network gives at scales s = 0 … 3."""

    logits: list[Tensor]  # (B, 1, H/2^s, W/2^s) before the sigmoid, float32
    features: Tensor  # (B, 16, H, W), the last
    added: list[Tensor] | None = None  # what HR-Net adds to LR-Net's logits, if it does

    @property
    def disparities(self) -> list[Tensor]:
        """Inverse depths (B, 1, H/2^s, W/2^s)."""
        return [DISPARITY_SCALE * torch.sigmoid(logit) + DISPARITY_OFFSET for logit in self.logits]


def in_float32(kind: str) -> contextlib.AbstractContextManager[object]:
    """No autocast on a kind of device; the meta device, on which operations are counted, has none to turn off."""
    return torch.autocast(kind, enabled=False) if torch.amp.is_autocast_available(kind) else contextlib.nullcontext()


class Decoder(nn.Module):
    """Features at strides 2 … 32, of `channels`, None where there is no stride-2 map → disparities at 1/1, 1/2, 1/4, 1/8 of the size."""

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
        self.merge = nn.ModuleList(nn.Sequential(conv3x3(w, w), nn.ELU(), conv3x3(w, w), nn.ELU()) for w in WIDTHS)
        self.heads = nn.ModuleList(conv3x3(w, 1) for w in WIDTHS[1:])
        for layer in self.modules():
            if isinstance(layer, nn.Conv2d):
                nn.init.xavier_uniform_(layer.weight)
                nn.init.zeros_(layer.bias)
        for head in self.heads:
            nn.init.zeros_(head.weight)
            nn.init.constant_(head.bias, START_LOGIT)

    def forward(self, maps: Sequence[Tensor | None], scales: int = 4) -> DepthOutput:
        """Decode the encoder's five maps (finest first); `scales` heads are run, from the finest on."""
        *finer, x = maps
        x = self.neck(x)
        logits: list[Tensor] = []
        for level, skip in enumerate([*reversed(finer), None]):
            x = F.interpolate(F.elu(self.up[level](x)), scale_factor=2, mode="nearest")
            if skip is not None:
                x = x + self.lateral[level](skip)
            x = self.merge[level](x)
            if level > 0 and len(WIDTHS) - level <= scales:
                with in_float32(x.device.type):  # bf16 cannot tell neighbouring depths apart
                    logits.insert(0, self.heads[level - 1](x.float()))
        return DepthOutput(logits, x)
