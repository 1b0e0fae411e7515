"""LR-Net: the global network (paper, "Dual Network Architecture"); also the single networks of the overhead table."""

from torch import Tensor, nn

from dualdepth.networks.decoder import Decoder, DepthOutput
from dualdepth.networks.encoders import make_encoder


class LRNet(nn.Module):
    """Encoder and decoder with skip connections: image → disparities at four scales.

    Args:
        encoder: see `make_encoder`.
        pretrained: ImageNet weights for the encoder.
    """

    def __init__(self, encoder: str = "resnet50", pretrained: bool | str = False) -> None:
        super().__init__()
        self.encoder = make_encoder(encoder, pretrained)
        self.decoder = Decoder(self.encoder.channels)

    def forward(self, image: Tensor, scales: int = 4) -> DepthOutput:
        """Disparities of an image (B, 3, H, W) in [0, 1]; H and W are multiples of 32."""
        return self.decoder(self.encoder(image), scales)
