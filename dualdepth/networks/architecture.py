"""Which depth network it is, in words that fit into a weights' card, and how it is built from them; torch is loaded only to build one."""

from typing import TYPE_CHECKING, Annotated

from pydantic import BaseModel, ConfigDict, Field

from dualdepth.networks import Link, Network, Normalise, Similarity

if TYPE_CHECKING:
    from torch import nn


_Side = Annotated[int, Field(strict=True, multiple_of=96, ge=192, le=10_000)]
HRSize = tuple[_Side, _Side]
"""(height, width) of HR-Net's images in pixels; 1/96 of a side, LR-Net's deepest map, must have room to be reflected."""


class Design(BaseModel):
    """Everything about a depth network but its encoder, as `variants.yaml` has it."""

    model_config = ConfigDict(frozen=True)

    network: Network = "lr"
    """`lr`: LR-Net on low-resolution images; `single`: the same network on high-resolution images; `dual`; `hr`: HR-Net by itself."""
    link: Link = "attention"
    """What a dual network's HR-Net receives: SA-Attention's features, its embedding without the mixing, or LR-Net's deepest map as it is
    ("w/o SA")."""
    similarity: Similarity = "dot"  # Of SA-Attention.
    normalise: Normalise = "none"  # Of SA-Attention.


class Architecture(Design):
    """A depth network; `build()` makes it, `model_dump()` is what a card says."""

    encoder: str = "resnet50"  # See `make_encoder`; of no meaning for `hr`.
    residual: bool = False  # Beyond the paper: a dual network's HR-Net adds to LR-Net's logits; of no meaning for others.

    @property
    def sees_low_resolution(self) -> bool:
        """Whether the network takes the image averaged 3×3 instead of the image."""
        return self.network == "lr"

    def build(self, pretrained: bool | str = False) -> "nn.Module":
        """The network with new weights; `pretrained` takes ImageNet's for the encoder."""
        from dualdepth.networks.depth_nets import DualNet, HRNet, LRNet

        if self.network == "hr":
            return HRNet()
        net = LRNet(self.encoder, pretrained)
        return DualNet(net, self.link, self.similarity, self.normalise, self.residual) if self.network == "dual" else net
