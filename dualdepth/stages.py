"""What one optimisation step computes, from a batch of bytes to the losses."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from dualdepth.config import Profile
from dualdepth.data.loading import low_resolution, to_unit
from dualdepth.geometry import resize_intrinsics
from dualdepth.losses import Losses, total_loss
from dualdepth.networks.lr_net import LRNet
from dualdepth.networks.pose_net import PoseNet


class StageOutput(NamedTuple):
    """Losses of a batch, what a picture of it needs, and what its numbers for the log are taken from; all but the losses is detached."""

    losses: Losses
    target: Tensor
    """(B, 3, H, W) in [0, 1]."""
    disparity: Tensor
    """(B, 1, H, W), finest scale."""
    poses: Tensor
    """(B, S, 6), target → source."""
    features: Tensor
    """(B, 16, H, W), the decoder's last."""
    attention_scale: Tensor | None = None
    """Root mean square of SA-Attention's features, where there are some."""

    @property
    @torch.no_grad()
    def statistics(self) -> dict[str, Tensor]:
        """Numbers for the log, 0-d: loss components, pose size (depth units, radians), disparity, spread of the features."""
        losses, disparity = self.losses, self.disparity
        numbers = {
            "loss": losses.total.detach(),
            "photometric": losses.photometric.detach(),
            "smoothness": losses.smoothness.detach(),
            "feature": losses.feature.detach(),
            "valid_share": losses.valid_share,
            "translation": self.poses[..., :3].norm(dim=-1).mean(),
            "rotation": self.poses[..., 3:].norm(dim=-1).mean(),
            "disparity_min": disparity.amin(),
            "disparity_mean": disparity.mean(),
            "disparity_max": disparity.amax(),
            "disparity_spread": disparity.std(dim=(2, 3)).mean() / disparity.mean(),
            "feature_spread": self.features.float().std(dim=(2, 3)).mean(),
        }
        return numbers if self.attention_scale is None else numbers | {"attention_scale": self.attention_scale}


class LRStage(nn.Module):
    """Stage 1: LR-Net and PoseNet learn together from LR images (paper, sections "Dual Network Architecture" and "Loss")."""

    def __init__(self, profile: Profile) -> None:
        super().__init__()
        training = profile.training
        self.loss = training.loss
        self.full_resolution_batch = training.augmentation.augment_first
        self.channels_last = training.channels_last
        self.depth_net = LRNet(training.encoder, training.pretrained)
        self.pose_net = PoseNet()

    def forward(self, batch: dict[str, Any]) -> StageOutput:
        """Losses of a batch with `images` (B, 3, 3, H, W) uint8, target first, and `intrinsics` (B, 3, 3)."""
        images, matrix = to_unit(batch["images"]), batch["intrinsics"]
        if self.full_resolution_batch:
            images, matrix = low_resolution(images), resize_intrinsics(matrix, 1 / 3, 1 / 3)
        with_features = self.loss.feature > 0
        views = images if with_features else images[:, :1]  # sources need depth features only for the feature loss
        network_input = views.flatten(0, 1)
        if self.channels_last:
            network_input = network_input.contiguous(memory_format=torch.channels_last)
        output = self.depth_net(network_input, self.loss.scales)
        poses = self.pose_net(images)
        disparities = [d.unflatten(0, views.shape[:2])[:, 0] for d in output.disparities]
        features = output.features.unflatten(0, views.shape[:2])
        with torch.autocast(images.device.type, enabled=False):
            losses = total_loss(
                images,
                matrix,
                disparities,
                poses,
                weights=(self.loss.photometric, self.loss.smoothness, self.loss.feature),
                alpha=self.loss.alpha,
                mean_disparity=self.loss.mean_disparity,
                features=(features[:, 0], features[:, 1:]) if with_features else None,
                automask=self.loss.beyond_paper_automask,
            )
        return StageOutput(losses, images[:, 0], disparities[0].detach(), poses.detach(), features[:, 0].detach())
