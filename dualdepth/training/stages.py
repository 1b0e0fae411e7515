"""What one optimisation step computes, from a batch of bytes to the losses."""

from typing import Any, NamedTuple

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.geometry import low_resolution, resize_intrinsics, to_unit
from dualdepth.losses import Losses, anchor, total_loss
from dualdepth.networks.depth_nets import DualNet
from dualdepth.networks.pose_net import EncoderPoseNet, PoseNet
from dualdepth.refinement import refined
from dualdepth.settings import Training

WALLS = 5.5  # How far aside a corridor's walls stand, in heights of the camera: 9 metres for one that is 1.65 metres above the road.


class StageOutput(NamedTuple):
    """Losses of a batch, what a picture of it needs, and what its numbers for the log are taken from; all but the losses is detached."""

    losses: Losses
    target: Tensor  # (B, 3, H, W) in [0, 1]
    disparity: Tensor  # (B, 1, H, W), finest scale
    poses: Tensor  # (B, S, 6), target → source
    features: Tensor  # (B, 16, H, W), the decoder's last
    attention_scale: Tensor | None = None  # root mean square of SA-Attention's features, where there are some

    @property
    @torch.no_grad()
    def statistics(self) -> dict[str, Tensor]:
        """Numbers for the log, 0-d: loss components, pose size (depth units, radians), disparity, spread of the features."""
        losses, disparity = self.losses, self.disparity
        parts = ("photometric", "smoothness", "feature", "valid_share")
        numbers = {"loss": losses.total.detach(), **{name: getattr(losses, name).detach() for name in parts}} | {
            "translation": self.poses[..., :3].norm(dim=-1).mean(),
            "rotation": self.poses[..., 3:].norm(dim=-1).mean(),
            "disparity_min": disparity.amin(),
            "disparity_mean": disparity.mean(),
            "disparity_max": disparity.amax(),
            "disparity_spread": disparity.std(dim=(2, 3)).mean() / disparity.mean(),
            "feature_spread": self.features.float().std(dim=(2, 3)).mean(),
        }
        return numbers if self.attention_scale is None else numbers | {"attention_scale": self.attention_scale}


class Stage(nn.Module):
    """A step of either stage (paper, sections "Dual Network Architecture" and "Loss").

    Stage 1: LR-Net and PoseNet learn together from LR images. Stage 2: the depth network learns from HR images by L_ph and L_smooth alone;
    PoseNet, a new one or that of stage 1, sees LR images as before and goes on learning unless it is frozen. In stage 1 (`low`) the depth
    network sees LR images, too; what is frozen in it stays so. `training` says losses, augmentation and memory layout.
    """

    def __init__(self, depth_net: nn.Module, pose_net: PoseNet | EncoderPoseNet, training: Training, *, low: bool) -> None:
        super().__init__()
        self.depth_net, self.pose_net = depth_net, pose_net
        self.loss, self.channels_last, self.low = training.loss, training.channels_last, low
        self.anchor, self.corridor_steps = training.beyond_paper_residual_anchor, training.beyond_paper_corridor_steps
        self.colour = training.augmentation.beyond_paper_colour
        self.from_nothing = isinstance(depth_net, DualNet) and not depth_net.residual
        self.hr_batch = training.augmentation.augment_first or not low
        """Whether batches have the HR size; frames that are shrunk before they are augmented have the LR size."""

    def train(self, mode: bool = True) -> "Stage":
        """Training mode for what learns; a frozen PoseNet keeps the statistics of stage 1."""
        super().train(mode)
        self.pose_net.train(mode and next(self.pose_net.parameters()).requires_grad)
        return self

    def forward(self, batch: dict[str, Any], in_a_corridor: bool = False, refine: bool = False) -> StageOutput:
        """Losses of a batch with `images` (B, 3, 3, H, W) uint8, target first, and `intrinsics` (B, 3, 3).

        In a corridor the depth network is left out: a road between walls stands for what it would say, so that PoseNet learns alone.
        Where poses are to be refined, losses take the refined ones, and PoseNet learns from their difference to its own. They are refined
        with the depth that learns, but in a dual network without residual with LR-Net's, since its own has no shape at first.
        """
        images, matrix = to_unit(batch["images"]), batch["intrinsics"]
        seen = recoloured(images, self.colour) if self.colour and self.training else images  # by the networks; losses compare `images`
        small = low_resolution(seen) if self.hr_batch else seen
        if self.low and self.hr_batch:
            images = small if seen is images else low_resolution(images)
            seen, matrix = small, resize_intrinsics(matrix, 1 / 3, 1 / 3)
        # the sources' depth features are needed for the feature loss alone
        with_features = self.low and self.loss.feature > 0 and not in_a_corridor
        poses, added, shaped = self.pose_net(small), None, None
        if in_a_corridor:
            disparities = corridor(matrix, images.shape[-2:], self.loss.scales)
            features = torch.zeros_like(disparities[0])[:, None]
        else:
            views = seen if with_features else seen[:, :1]
            network_input = views.flatten(0, 1)
            if self.channels_last:
                network_input = network_input.contiguous(memory_format=torch.channels_last)
            if refine and self.from_nothing:
                output, low_output = self.depth_net(network_input, self.loss.scales, with_lr_depth=True)
                shaped = low_output.disparities[0]
            else:
                output = self.depth_net(network_input, self.loss.scales)
            added = output.added
            disparities = [d.unflatten(0, views.shape[:2])[:, 0] for d in output.disparities]
            features = output.features.unflatten(0, views.shape[:2])
        with torch.autocast(images.device.type, enabled=False):
            pair = (features[:, 0], features[:, 1:]) if with_features else None
            predicted = poses
            if refine:
                share = small.shape[-1] / images.shape[-1]
                small_matrix = resize_intrinsics(matrix, share, share)
                shaped = disparities[0] if shaped is None else shaped
                poses = refined(small, shaped, predicted, small_matrix, self.loss.mean_disparity)
            losses = total_loss(images, matrix, disparities, poses, self.loss, pair)
            if self.anchor and added:
                losses = losses._replace(total=losses.total + self.anchor * anchor(added, images[:, 0]))
            if refine:
                losses = losses._replace(total=losses.total + (predicted - poses).abs().mean())
        scale = getattr(getattr(self.depth_net, "attention", None), "scale", None)
        return StageOutput(losses, images[:, 0], disparities[0].detach(), poses.detach(), features[:, 0].detach(), scale)


def recoloured(images: Tensor, most: float) -> Tensor:
    """Images (B, V, 3, H, W) in [0, 1] whose brightness, saturation and contrast are times 1 ± `most`, drawn for each item."""
    draws = torch.rand(3, len(images), 1, 1, 1, 1, device=images.device)
    brightness, saturation, contrast = 1.0 + most * (2.0 * draws - 1.0)
    images = images * brightness
    grey = images.mean(dim=2, keepdim=True)
    images = grey + saturation * (images - grey)
    middle = images.mean(dim=(1, 2, 3, 4), keepdim=True)
    return (middle + contrast * (images - middle)).clamp(0.0, 1.0)


def corridor(intrinsics: Tensor, size: tuple[int, int], scales: int) -> list[Tensor]:
    """Disparities (B, 1, H/2^s, W/2^s) of a level road between two walls, seen along it.

    The road's rise with a row's distance below the horizon, which is taken to be at the principal point, the walls' with a column's
    distance to the middle; they have no upper edge. It is equally far up to a twelfth of the image's height below the horizon, and up to
    5.5 times that to either side of the middle. `intrinsics` (B, 3, 3) are those at `size` (H, W); `scales` are from the finest on.
    """
    height, width = size
    fx, fy, cx, cy = (intrinsics[:, row, column, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))  # (B, 1)
    rows = torch.arange(height, device=intrinsics.device) - cy  # (B, H)
    columns = (torch.arange(width, device=intrinsics.device) - cx) * fy / fx  # (B, W)
    nearest = torch.maximum(rows[:, :, None], columns[:, None, :].abs() / WALLS)
    finest = (12.0 / height * nearest).clamp(min=1.0)[:, None]
    return [F.avg_pool2d(finest, 2**scale) if scale else finest for scale in range(scales)]
