"""What one optimisation step of stage 2 computes: high-resolution losses of a network that was led, or not, by a frozen LR-Net."""

from typing import Any

import torch
from torch import nn

from dualdepth.config import Profile
from dualdepth.data.loading import low_resolution, to_unit
from dualdepth.losses import total_loss
from dualdepth.networks.pose_net import PoseNet
from dualdepth.stages import StageOutput


class HRStage(nn.Module):
    """Stage 2: the depth network learns from HR images by L_ph and L_smooth alone (paper, section "Loss").

    PoseNet sees LR images as in stage 1 and goes on learning. Only the target goes through the depth network: without the feature
    loss nobody asks for the sources' features.

    Args:
        profile: losses and memory layout.
        depth_net: from HR images to disparities; what is frozen in it stays so.
        pose_net: of stage 1, or a new one.
    """

    def __init__(self, profile: Profile, depth_net: nn.Module, pose_net: PoseNet) -> None:
        super().__init__()
        self.loss, self.channels_last = profile.training.loss, profile.training.channels_last
        self.depth_net, self.pose_net = depth_net, pose_net

    def forward(self, batch: dict[str, Any]) -> StageOutput:
        """Losses of a batch with `images` (B, 3, 3, H, W) uint8 at the HR size, target first, and `intrinsics` (B, 3, 3)."""
        images, matrix = to_unit(batch["images"]), batch["intrinsics"]
        target = images[:, 0]
        if self.channels_last:
            target = target.contiguous(memory_format=torch.channels_last)
        output = self.depth_net(target, self.loss.scales)
        poses = self.pose_net(low_resolution(images))
        with torch.autocast(images.device.type, enabled=False):
            losses = total_loss(
                images,
                matrix,
                output.disparities,
                poses,
                weights=(self.loss.photometric, self.loss.smoothness, 0.0),
                alpha=self.loss.alpha,
                mean_disparity=self.loss.mean_disparity,
                automask=self.loss.beyond_paper_automask,
            )
        scale = getattr(getattr(self.depth_net, "attention", None), "scale", None)
        return StageOutput(losses, target, output.disparities[0].detach(), poses.detach(), output.features.detach(), scale)
