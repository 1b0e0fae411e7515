"""SA-Attention: LR-Net's deepest features, bundled with those of similar positions (paper, section "SA-Attention Module")."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.networks import Normalise, Similarity
from dualdepth.networks.decoder import in_float32

WIDTH = 128  # Channels of the embedding f′; fitted to the paper's overhead table.
STARTING_RMS = 0.8
"""Root mean square of f″ before the first step, that of the HR-Net features beside it. The literal form is cubic in f′, and with the usual
first weights it starts up to a hundred times larger, by the encoder and its weights. An assumption; the paper is silent."""


class SelfAssembledAttention(nn.Module):
    """f″_j = Σ_i w_ij f′_i over all positions i, where f′ embeds LR features, colours and coordinates (paper's two equations).

    Args:
        channels: of LR-Net's deepest map.
        similarity: w_ij: `dot` is the paper's f′_i · f′_j; `cosine`, `l1`, `l2` are the choices it names, distances d as 1 / (1 + d).
        normalise: `none` is the paper's; `mean` divides by the number of positions, `softmax` makes the weights of a position sum to 1.
        mixing: False gives f′ itself, the same size without attention.
    """

    def __init__(self, channels: int, similarity: Similarity = "dot", normalise: Normalise = "none", mixing: bool = True) -> None:
        super().__init__()
        self.similarity, self.normalise, self.mixing = similarity, normalise, mixing
        self.embed = nn.Conv2d(channels + 3 + 2, WIDTH, 1)
        self.register_buffer("gain", torch.ones(()))  # of f″, fixed where a training begins
        self.scale: Tensor | None = None  # root mean square of the last training batch's f″ (0-d)

    def forward(self, features: Tensor, image: Tensor) -> Tensor:
        """Assembled features (B, 128, h, w) of features (B, C, h, w) and the image (B, 3, H, W) in [0, 1]; float32 throughout."""
        with in_float32(features.device.type):
            features = features.float()
            h, w = features.shape[-2:]
            colours = F.adaptive_avg_pool2d(image.float(), (h, w))
            embedded = self.embed(torch.cat([features, colours, coordinates(features)], dim=1))  # f′ (B, 128, h, w)
            f = embedded.flatten(2)  # (B, 128, h·w)
            assembled = self.gain * ((f @ self.weights(f)).unflatten(2, (h, w)) if self.mixing else embedded)  # f″_j = Σ_i f′_i w_ij
            if self.training:
                self.scale = assembled.detach().square().mean().sqrt()
            return assembled

    @torch.no_grad()
    def begin(self, features: Tensor, image: Tensor) -> None:
        """Fix the gain, before the first step, with which f″ of this batch has the root mean square STARTING_RMS.

        To shrink f′ instead would be unstable: a step of Adam at the paper's rate is then a tenth of a weight, and f″ is cubic in them.
        """
        self.gain.fill_(1.0)
        self.gain.fill_(STARTING_RMS / self(features, image).square().mean().sqrt())

    def weights(self, f: Tensor) -> Tensor:
        """w_ij (B, N, N) of embedded features (B, C, N)."""
        if self.similarity == "dot":
            w = f.mT @ f
        elif self.similarity == "cosine":
            unit = F.normalize(f, dim=1)
            w = unit.mT @ unit
        else:
            w = 1.0 / (1.0 + distances(f, 1 if self.similarity == "l1" else 2))
        if self.normalise == "mean":
            return w / f.shape[2]
        return w.softmax(dim=1) if self.normalise == "softmax" else w


def distances(f: Tensor, order: int) -> Tensor:
    """L1 or L2 distances (B, N, N) between the columns of (B, C, N); the ε keeps L2's gradient finite at equal columns."""
    difference = f.unsqueeze(3) - f.unsqueeze(2)
    return difference.abs().sum(1) if order == 1 else difference.square().sum(1).add(1e-8).sqrt()


def coordinates(features: Tensor) -> Tensor:
    """Coordinates x, y of each position, from −1 at the first to 1 at the last: (B, 2, h, w)."""
    b, _, h, w = features.shape
    y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, device=features.device) for n in (h, w)), indexing="ij")
    return torch.stack([x, y]).to(features).expand(b, 2, h, w)
