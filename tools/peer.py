"""A peer's training step, for `make bench`: monodepth2 (C. Godard et al., "Digging Into Self-Supervised Monocular Depth Estimation", ICCV
2019), written anew from its paper: ResNet18, its depth decoder, its pose network of a second ResNet18, its loss. It stands for how fast
such a step is, and learns nothing here."""

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.geometry import pixel_grid, pose_matrix
from dualdepth.networks.encoders import make_encoder

WIDTHS = (16, 32, 64, 128, 256)
NEAREST, FARTHEST = 0.1, 100.0


def resnet18(channels: int = 3) -> nn.Module:
    """ResNet18 with borders of zeros, for images of so many channels."""
    encoder = make_encoder("resnet18")
    for layer in [layer for layer in encoder.modules() if isinstance(layer, nn.Conv2d)]:
        layer.__class__, layer.padding_mode = nn.Conv2d, "zeros"
        if layer.in_channels == 3 and channels != 3:
            layer.in_channels, layer.weight = channels, nn.Parameter(layer.weight.repeat(1, channels // 3, 1, 1))
    encoder.mean, encoder.std = encoder.mean.repeat(1, channels // 3, 1, 1), encoder.std.repeat(1, channels // 3, 1, 1)
    for setting in (module for module in encoder.modules() if hasattr(module, "num_channels")):
        setting.num_channels = channels
    return encoder


class DepthNet(nn.Module):
    """Encoder and decoder: at each level a convolution, an enlargement, the encoder's map beside it, another convolution."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder, skips = resnet18(), (0, 64, 64, 128, 256)

        def block(inputs: int, outputs: int) -> nn.Module:
            return nn.Sequential(nn.ReflectionPad2d(1), nn.Conv2d(inputs, outputs, 3), nn.ELU())

        self.first = nn.ModuleList(block(512 if level == 4 else WIDTHS[level + 1], WIDTHS[level]) for level in range(5))
        self.second = nn.ModuleList(block(WIDTHS[level] + skips[level], WIDTHS[level]) for level in range(5))
        self.heads = nn.ModuleList(nn.Sequential(nn.ReflectionPad2d(1), nn.Conv2d(WIDTHS[level], 1, 3)) for level in range(4))

    def forward(self, image: Tensor) -> list[Tensor]:
        """Disparities in (0, 1) at 1/1, 1/2, 1/4 and 1/8 of the size."""
        *maps, x = self.encoder(image)
        found: list[Tensor] = []
        for level in reversed(range(5)):
            x = F.interpolate(self.first[level](x), scale_factor=2, mode="nearest")
            x = self.second[level](torch.cat([x, maps[level - 1]], 1) if level else x)
            found = [torch.sigmoid(self.heads[level](x).float()), *found] if level < 4 else found
        return found


class PoseNet(nn.Module):
    """Two images, 6 channels → one pose (B, 6)."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = resnet18(6)
        layers = [
            nn.Conv2d(512, 256, 1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
            nn.Conv2d(256, 256, 3, padding=1),
            nn.ReLU(),
        ]
        self.layers = nn.Sequential(*layers, nn.Conv2d(256, 6, 1))

    def forward(self, pair: Tensor) -> Tensor:
        """Target → source."""
        return 0.01 * self.layers(self.encoder(pair)[-1]).mean((2, 3)).float()


class Peer(nn.Module):
    """A whole step up to its loss (scalar): minimum over sources, automask, all scales at full size."""

    def __init__(self) -> None:
        super().__init__()
        self.depth_net, self.pose_net = DepthNet(), PoseNet()

    def forward(self, images: Tensor, intrinsics: Tensor) -> Tensor:
        """Of images (B, 3, 3, H, W) in [0, 1], target first, and intrinsics (B, 3, 3)."""
        target, sources = images[:, 0], images[:, 1:].unbind(1)
        disparities = self.depth_net(target)
        poses = [self.pose_net(torch.cat([target, source], 1)) for source in sources]
        with torch.autocast(images.device.type, enabled=False):
            still = [photometric_error(source, target) for source in sources]
            total = images.new_zeros(())
            for scale, disparity in enumerate(disparities):
                full = F.interpolate(disparity, images.shape[-2:], mode="bilinear", align_corners=False)
                depth = 1 / (1 / FARTHEST + (1 / NEAREST - 1 / FARTHEST) * full)
                errors = [photometric_error(warped(s, depth, pose, intrinsics), target) for s, pose in zip(sources, poses)]
                total = total + torch.cat([*still, *errors], 1).amin(1).mean() + 1e-3 * smoothness(disparity, target) / 2**scale
            return total / len(disparities)


def warped(source: Tensor, depth: Tensor, pose: Tensor, intrinsics: Tensor) -> Tensor:
    """The source seen from the target: points from depth, moved, projected, sampled."""
    height, width = depth.shape[-2:]
    points = torch.linalg.inv(intrinsics) @ pixel_grid(height, width, depth.device) * depth.flatten(2)
    moved = pose_matrix(pose)[:, :3] @ torch.cat([points, torch.ones_like(points[:, :1])], 1)
    seen = intrinsics @ moved
    pixel = (seen[:, :2] / (seen[:, 2:] + 1e-7)).unflatten(2, (height, width)).permute(0, 2, 3, 1)
    scale = torch.tensor([width - 1, height - 1], device=depth.device)
    return F.grid_sample(source, (pixel / scale - 0.5) * 2, padding_mode="border", align_corners=False)


def photometric_error(a: Tensor, b: Tensor) -> Tensor:
    """0.85 (1 − SSIM)/2 + 0.15 |a − b| (B, 1, H, W), SSIM by means over 3×3 pixels."""
    x, y = (F.pad(image, (1, 1, 1, 1), mode="reflect") for image in (a, b))
    mx, my = F.avg_pool2d(x, 3, 1), F.avg_pool2d(y, 3, 1)
    vx, vy, vxy = F.avg_pool2d(x**2, 3, 1) - mx**2, F.avg_pool2d(y**2, 3, 1) - my**2, F.avg_pool2d(x * y, 3, 1) - mx * my
    similar = (2 * mx * my + 1e-4) * (2 * vxy + 9e-4) / ((mx**2 + my**2 + 1e-4) * (vx + vy + 9e-4))
    return (0.85 * ((1 - similar) / 2).clamp(0, 1) + 0.15 * (a - b).abs()).mean(1, keepdim=True)


def smoothness(disparity: Tensor, image: Tensor) -> Tensor:
    """Mean of |∂d| e^−|∂I| of the disparity divided by its mean."""
    image, d = F.interpolate(image, disparity.shape[-2:], mode="area"), disparity / (disparity.mean((2, 3), keepdim=True) + 1e-7)
    return sum((d.diff(dim=k).abs() * torch.exp(-image.diff(dim=k).abs().mean(1, keepdim=True))).mean() for k in (2, 3))
