"""The depth networks: LR-Net, HR-Net, and both of them as the dual network (paper, section "Dual Network Architecture")."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.networks import Link, Normalise, Similarity
from dualdepth.networks.attention import WIDTH, SelfAssembledAttention
from dualdepth.networks.convolution import conv3x3
from dualdepth.networks.decoder import Decoder, DepthOutput
from dualdepth.networks.encoders import make_encoder, outputs

HR_WIDTHS = (32, 64, 128, 128, 128)
"""HR-Net's channels at strides 2, 4, 8, 16, 32: a declared reconstruction, fitted like the decoder's to the paper's overhead table."""


class LRNet(nn.Module):
    """Encoder and decoder with skip connections: image → disparities at four scales; also the single networks of the overhead table.

    `encoder` and `pretrained` are those of `make_encoder`.
    """

    def __init__(self, encoder: str = "resnet50", pretrained: bool | str = False) -> None:
        super().__init__()
        self.encoder = make_encoder(encoder, pretrained)
        self.decoder = Decoder(self.encoder.channels)

    def forward(self, image: Tensor, scales: int = 4) -> DepthOutput:
        """Disparities of an image (B, 3, H, W) in [0, 1]; H and W are multiples of 32."""
        return self.decoder(self.encoder(image), scales)


class HREncoder(nn.Module):
    """Five stages, each a 3×3 convolution of stride 2 and one of stride 1, with batch norm and ELU; reflection padding."""

    def __init__(self) -> None:
        super().__init__()
        self.stages = nn.ModuleList(
            nn.Sequential(*_block(before, width, 2), *_block(width, width, 1)) for before, width in zip((3, *HR_WIDTHS), HR_WIDTHS)
        )

    def forward(self, image: Tensor) -> list[Tensor]:
        """Maps at strides 2 … 32 of an image (B, 3, H, W) in [0, 1]; H and W multiples of 32."""
        return outputs(self.stages, 2.0 * image - 1.0)


class HRNet(nn.Module):
    """The slim network that sees the full resolution, with room for global features at stride 32.

    `global_channels` are those of LR-Net's features; 0 for HR-Net by itself, which the paper says cannot work alone.
    """

    def __init__(self, global_channels: int = 0) -> None:
        super().__init__()
        self.encoder = HREncoder()
        self.decoder = Decoder((*HR_WIDTHS[:-1], HR_WIDTHS[-1] + global_channels))

    def forward(self, image: Tensor, scales: int = 4, global_features: Tensor | None = None) -> DepthOutput:
        """Disparities of an image (B, 3, H, W) in [0, 1], with global features (B, C, H/32, W/32) if it was built for them."""
        *finer, deepest = self.encoder(image)
        if global_features is not None:
            deepest = torch.cat([deepest, global_features.to(deepest.dtype)], dim=1)
        return self.decoder([*finer, deepest], scales)


class DualNet(nn.Module):
    """HR-Net led by a frozen LR-Net's deepest features, enlarged ×3 to HR-Net's stride 32 (paper, figure "Overview of our method", b).

    LR-Net sees the image averaged 3×3. It stays in eval mode and gets no gradient, so training leaves it as it was; its decoder
    is not run unless it is asked for, since the depth at high resolution does not need it.

    Args:
        lr_net: of stage 1; its parameters are frozen here.
        link, similarity, normalise: what HR-Net receives, see `Design`.
        residual: beyond the paper, HR-Net's logits are added to LR-Net's, enlarged and not below `floor` (none until a training or
            weights set it), so that it begins with LR-Net's depth.
    """

    def __init__(
        self, lr_net: LRNet, link: Link = "attention", similarity: Similarity = "dot", normalise: Normalise = "none", residual: bool = False
    ) -> None:
        super().__init__()
        self.residual = residual
        self.lr_net = lr_net.requires_grad_(False)
        deepest = lr_net.encoder.channels[-1]
        self.attention = None if link == "direct" else SelfAssembledAttention(deepest, similarity, normalise, mixing=link == "attention")
        self.hr_net = HRNet(deepest if self.attention is None else WIDTH)
        if residual:
            self.register_buffer("floor", torch.tensor(-torch.inf))  # among the weights, which were trained above it
            for head in self.hr_net.decoder.heads:
                nn.init.zeros_(head.bias)
        self.train(self.training)

    def begin(self, image: Tensor) -> None:
        """Give SA-Attention its starting scale, before the first step, from images (B, 3, H, W) of the training."""
        if self.attention:
            low = F.avg_pool2d(image, 3)
            with torch.no_grad():
                self.attention.begin(self.lr_net.encoder(low)[-1], low)

    def train(self, mode: bool = True) -> "DualNet":
        """Training mode for all but LR-Net, whose batch norm keeps the statistics of stage 1."""
        super().train(mode)
        self.lr_net.eval()
        return self

    def forward(self, image: Tensor, scales: int = 4, with_lr_depth: bool = False) -> DepthOutput | tuple[DepthOutput, DepthOutput]:
        """Disparities of an image (B, 3, H, W) in [0, 1], H and W multiples of 96; LR-Net's own behind them if they are asked for."""
        low = F.avg_pool2d(image, 3)
        with torch.no_grad():
            maps = self.lr_net.encoder(low)
        handed = self.attention(maps[-1], low) if self.attention else maps[-1]  # (B, C, H/96, W/96)
        enlarged = F.interpolate(handed, scale_factor=3, mode="bilinear", align_corners=False)
        output = self.hr_net(image, scales, enlarged)
        if self.residual or with_lr_depth:
            with torch.no_grad():
                low_output = self.lr_net.decoder(maps)
        if self.residual:
            floored = low_output.logits[0].clamp(min=self.floor)
            start = (F.interpolate(floored, x.shape[-2:], mode="bilinear", align_corners=False) for x in output.logits)
            output = output._replace(logits=[x + s for x, s in zip(output.logits, start)], added=output.logits)
        return (output, low_output) if with_lr_depth else output


def _block(width_in: int, width: int, stride: int) -> list[nn.Module]:
    return [conv3x3(width_in, width, stride, bias=False), nn.BatchNorm2d(width), nn.ELU()]
