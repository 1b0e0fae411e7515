"""Beyond the paper: poses on which images and depth agree, by direct image alignment, as in DDVO (Wang et al., CVPR 2018)."""

import torch
from torch import Tensor
from torch.nn import functional as F

from dualdepth.geometry import pose_matrix, pose_of, reproject, resize_intrinsics, sample

LEVELS = (4, 2, 1)  # Times that images are shrunk, one after the other.
TURNS = 8  # Times that larger images are shrunk at first, for turns alone: at 128×416 one of 3° moves the image by 14 pixels.
LARGE = 96  # Rows from which images are large.
DAMPING = 1e-3  # Of each Gauss-Newton step, as a share of the matrix's diagonal.


@torch.no_grad()
def refined(
    images: Tensor, disparity: Tensor, poses: Tensor, intrinsics: Tensor, mean_disparity: float = 1.0, iterations: int = 3
) -> Tensor:
    """Poses after Gauss-Newton steps that lower the difference of target and warped sources, without gradient: (B, S, 6).

    A pose after which they differ more stays as it was.

    Args:
        images: (B, 1 + S, 3, H, W) in [0, 1], target first.
        disparity: of the target, (B, 1, h, w), of any size and scale.
        poses: (B, S, 6), target → source, such as PoseNet's.
        intrinsics: (B, 3, 3) at the images' size.
        mean_disparity: that disparities are divided to, in whose unit translations are (`settings.Loss`).
        iterations: at each level.
    """
    sources = images.shape[1] - 1
    grey = images.float().mean(dim=2)
    disparity = F.adaptive_avg_pool2d(disparity.float(), images.shape[-2:])
    disparity = mean_disparity * disparity / disparity.mean(dim=(2, 3), keepdim=True)
    start = transform = pose_matrix(poses.float()).flatten(0, 1)
    for shrunk in (*[TURNS] * (grey.shape[-2] >= LARGE), *LEVELS):
        small = F.avg_pool2d(grey, shrunk)
        mean = _mean(small)
        small = (small - mean) / ((_mean(small * small) - mean * mean).clamp(min=0).sqrt() + 0.03)  # whatever the exposure was
        level = F.avg_pool2d(disparity, shrunk), resize_intrinsics(intrinsics, 1 / shrunk, 1 / shrunk)
        steps = _Steps(small[:, :1], small[:, 1:], *(value.repeat_interleave(sources, 0) for value in level))
        if shrunk == TURNS:  # so small, directions of steps are uncertain, and would lead astray
            steps.jacobian[:, :3] = 0.0
        for _ in range(6 if shrunk == TURNS else iterations):
            transform = steps.next(transform)
    better = steps.error(transform) < steps.error(start)
    return torch.where(better[:, None], pose_of(transform), poses.float().flatten(0, 1)).unflatten(0, (-1, sources))


def _mean(images: Tensor) -> Tensor:
    """Over 7×7 pixels of (B, V, H, W)."""
    return F.avg_pool2d(images, 7, 1, 3, count_include_pad=False)


class _Steps:
    """Inverse compositional Gauss-Newton steps at one level (Baker and Matthews, 2004): the target's gradients serve all of them."""

    def __init__(self, target: Tensor, sources: Tensor, disparity: Tensor, intrinsics: Tensor) -> None:
        """Of `target` (B, 1, H, W) and `sources` (B, S, H, W); disparity (B·S, 1, H, W) and intrinsics (B·S, 3, 3)."""
        self.target, self.source = target.repeat_interleave(sources.shape[1], 0), sources.flatten(0, 1)[:, None]
        self.disparity, self.intrinsics = disparity, intrinsics
        fx, fy, cx, cy = (intrinsics[:, row, column, None, None] for row, column in ((0, 0), (1, 1), (0, 2), (1, 2)))
        height, width = target.shape[-2:]
        x = (torch.arange(width, device=target.device) - cx) / fx  # (B·S, 1, W)
        y = (torch.arange(height, device=target.device)[:, None] - cy) / fy  # (B·S, H, 1)
        padded = F.pad(self.target, (1, 1, 1, 1), mode="replicate")[:, 0]
        gx, gy = fx * (padded[:, 1:-1, 2:] - padded[:, 1:-1, :-2]) / 2, fy * (padded[:, 2:, 1:-1] - padded[:, :-2, 1:-1]) / 2
        along, near = gx * x + gy * y, disparity[:, 0]
        motions = gx * near, gy * near, -along * near, -gy - along * y, gx + along * x, gy * x - gx * y  # tx, ty, tz, rx, ry, rz
        self.jacobian = torch.stack(motions, 1).flatten(2)  # (B·S, 6, H·W)

    def _residual(self, transform: Tensor) -> tuple[Tensor, Tensor]:
        """Warped source less target, and where it is seen: (B·S, H·W)."""
        pixel, valid = reproject(self.disparity, transform, self.intrinsics)
        return (sample(self.source, pixel) - self.target).flatten(1), valid.flatten(1)

    def error(self, transform: Tensor) -> Tensor:
        """Mean absolute difference (B·S) over the pixels that are seen; without any not a number, which is never better."""
        residual, seen = self._residual(transform)
        return (residual.abs() * seen).sum(1) / seen.sum(1)

    def next(self, transform: Tensor) -> Tensor:
        """The transform after one step; pixels count the less the more they differ (Cauchy's weights), such as those of moving cars."""
        residual, seen = self._residual(transform)
        spread = 2 * 1.48 * residual.abs().median(dim=1, keepdim=True).values + 1e-3
        weighted = self.jacobian * (seen / (1 + (residual / spread) ** 2))[:, None]
        matrix = weighted @ self.jacobian.mT
        matrix += torch.diag_embed(DAMPING * matrix.diagonal(dim1=1, dim2=2) + 1e-6)
        step = torch.linalg.solve_ex(matrix, weighted @ residual[:, :, None]).result[..., 0]
        return transform @ pose_matrix(-step)
