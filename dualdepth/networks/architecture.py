"""Which network it is, in words that fit into a weights' card, and how it is built from them."""

import dataclasses
from typing import Any, Literal, get_args

from torch import nn

from dualdepth.networks.attention import Normalise, Similarity
from dualdepth.networks.dual_net import DualNet, Link
from dualdepth.networks.hr_net import HRNet
from dualdepth.networks.lr_net import LRNet

Network = Literal["lr", "single", "dual", "hr"]


@dataclasses.dataclass(frozen=True)
class Architecture:
    """A depth network; `build()` makes it."""

    network: Network = "lr"
    """`lr`: LR-Net on low-resolution images; `single`: the same network on high-resolution images; `dual`; `hr`: HR-Net by itself."""
    encoder: str = "resnet50"
    """See `make_encoder`; of no meaning for `hr`."""
    link: Link = "attention"
    similarity: Similarity = "dot"
    normalise: Normalise = "none"

    def __post_init__(self) -> None:
        choices = {"network": Network, "link": Link, "similarity": Similarity, "normalise": Normalise}
        for field, known in choices.items():
            if getattr(self, field) not in get_args(known):
                raise ValueError(f"{field} {getattr(self, field)!r} is unknown: choose one of {', '.join(get_args(known))}")

    @property
    def sees_low_resolution(self) -> bool:
        """Whether the network takes the image averaged 3×3 instead of the image."""
        return self.network == "lr"

    def build(self, pretrained: bool | str = False) -> nn.Module:
        """The network with new weights; `pretrained` takes ImageNet's for the encoder."""
        if self.network == "hr":
            return HRNet()
        net = LRNet(self.encoder, pretrained)
        return DualNet(net, self.link, self.similarity, self.normalise) if self.network == "dual" else net

    def words(self) -> dict[str, Any]:
        """What a card says; `Architecture(**words)` is this again."""
        return dataclasses.asdict(self)
