"""The dual network: a frozen LR-Net, SA-Attention, HR-Net (paper, figure "Overview of our method", b)."""

from typing import Literal

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.networks.attention import WIDTH, Normalise, SelfAssembledAttention, Similarity
from dualdepth.networks.decoder import DepthOutput
from dualdepth.networks.hr_net import HRNet
from dualdepth.networks.lr_net import LRNet

Link = Literal["attention", "embedding", "direct"]
"""What HR-Net is handed: SA-Attention's features, its embedding without the mixing, or LR-Net's deepest map as it is ("w/o SA")."""


class DualNet(nn.Module):
    """HR-Net led by a frozen LR-Net's deepest features, enlarged ×3 to HR-Net's stride 32.

    LR-Net sees the image averaged 3×3. It stays in eval mode and gets no gradient, so training leaves it as it was; its decoder
    is not run, since the depth at high resolution does not need it.

    Args:
        lr_net: of stage 1; its parameters are frozen here.
        link: see `Link`.
        similarity: of SA-Attention.
        normalise: of SA-Attention.
    """

    def __init__(self, lr_net: LRNet, link: Link = "attention", similarity: Similarity = "dot", normalise: Normalise = "none") -> None:
        super().__init__()
        self.lr_net = lr_net.requires_grad_(False)
        deepest = lr_net.encoder.channels[-1]
        self.attention = None if link == "direct" else SelfAssembledAttention(deepest, similarity, normalise, mixing=link == "attention")
        self.hr_net = HRNet(deepest if self.attention is None else WIDTH)
        self.train(self.training)

    def train(self, mode: bool = True) -> "DualNet":
        """Training mode for all but LR-Net, whose batch norm keeps the statistics of stage 1."""
        super().train(mode)
        self.lr_net.eval()
        return self

    def forward(self, image: Tensor, scales: int = 4) -> DepthOutput:
        """Disparities of an image (B, 3, H, W) in [0, 1]; H and W are multiples of 96."""
        low = F.avg_pool2d(image, 3)
        with torch.no_grad():
            features = self.lr_net.encoder(low)[-1]  # (B, C, H/96, W/96)
        handed = features if self.attention is None else self.attention(features, low)
        enlarged = F.interpolate(handed, scale_factor=3, mode="bilinear", align_corners=False)
        return self.hr_net(image, scales, enlarged)


class BothDepths(nn.Module):
    """A dual network that gives LR-Net's disparities too, as the paper counts its cost: `(HR output, LR output)`."""

    def __init__(self, net: DualNet) -> None:
        super().__init__()
        self.net = net

    def forward(self, image: Tensor) -> tuple[DepthOutput, DepthOutput]:
        """Both outputs of an image (B, 3, H, W); LR-Net's encoder is run once."""
        kept: list = []
        handle = self.net.lr_net.encoder.register_forward_hook(lambda _module, _inputs, maps: kept.append(maps))
        try:
            high = self.net(image)
        finally:
            handle.remove()
        return high, self.net.lr_net.decoder(kept[0])
