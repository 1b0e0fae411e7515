"""View synthesis: poses, projection and differentiable sampling (paper, equation 1).

Pixel (0, 0) is the centre of the first pixel everywhere, so that resizing by a factor s maps u to (u + 0.5) · s − 0.5,
as OpenCV's and torch's (`align_corners=False`) resizing do.
"""

import itertools

import torch
from torch import Tensor
from torch.nn import functional as F

GPU = "cuda"  # Where some of torch's gradients add up in any order, and ours are written so that they do not.
MIN_Z = 1e-3  # Points nearer than this share of their target depth in the source camera count as behind it.


def rotation_matrix(angles: Tensor) -> Tensor:
    """Rotation R = Rx · Ry · Rz (Zhou et al.) of angles (…, 3) in radians, clipped to ±π; returns (…, 3, 3)."""
    x, y, z = angles.clamp(-torch.pi, torch.pi).unbind(-1)
    zero, one = torch.zeros_like(x), torch.ones_like(x)
    cx, sx, cy, sy, cz, sz = x.cos(), x.sin(), y.cos(), y.sin(), z.cos(), z.sin()

    def matrix(*entries: Tensor) -> Tensor:
        return torch.stack(entries, -1).unflatten(-1, (3, 3))

    rx = matrix(one, zero, zero, zero, cx, -sx, zero, sx, cx)
    ry = matrix(cy, zero, sy, zero, one, zero, -sy, zero, cy)
    rz = matrix(cz, -sz, zero, sz, cz, zero, zero, zero, one)
    return rx @ ry @ rz


def pose_matrix(pose: Tensor) -> Tensor:
    """Rigid transform (…, 4, 4) of poses (…, 6) = tx, ty, tz, rx, ry, rz: target camera coordinates → source camera coordinates."""
    rows = torch.cat([rotation_matrix(pose[..., 3:]), pose[..., :3, None]], dim=-1)
    last = pose.new_zeros(*pose.shape[:-1], 1, 4)  # made on the device: a copy to it would wait for all before
    last[..., 3].fill_(1.0)
    return torch.cat([rows, last], dim=-2)


def pose_of(transform: Tensor) -> Tensor:
    """The pose (…, 6) whose `pose_matrix` is a rigid transform (…, 4, 4), for a turn about y of less than a right angle."""
    x = torch.atan2(-transform[..., 1, 2], transform[..., 2, 2])
    z = torch.atan2(-transform[..., 0, 1], transform[..., 0, 0])
    angles = torch.stack([x, torch.asin(transform[..., 0, 2].clamp(-1, 1)), z], -1)
    return torch.cat([transform[..., :3, 3], angles], dim=-1)


def inverse_pose(pose: Tensor) -> Tensor:
    """The pose (…, 6) whose `pose_matrix` is the inverse of that of `pose` (…, 6), for a turn about y of less than a right angle."""
    turned = rotation_matrix(pose[..., 3:]).mT
    return pose_of(torch.cat([turned, -turned @ pose[..., :3, None]], dim=-1))


def resize_intrinsics(intrinsics: Tensor, scale_x: float, scale_y: float) -> Tensor:
    """Intrinsics (…, 3, 3) of the same view after resizing its image by `scale_x`, `scale_y`.

    The principal point follows pixel centres: c → (c + 0.5) · scale − 0.5.
    """
    resized = intrinsics.clone()
    resized[..., 0, :] *= scale_x
    resized[..., 1, :] *= scale_y
    resized[..., 0, 2] += 0.5 * scale_x - 0.5
    resized[..., 1, 2] += 0.5 * scale_y - 0.5
    return resized


def pixel_grid(height: int, width: int, device: torch.device | None = None) -> Tensor:
    """Homogeneous pixel coordinates (3, height · width): u, v, 1."""
    v, u = torch.meshgrid(
        torch.arange(height, device=device, dtype=torch.float32), torch.arange(width, device=device, dtype=torch.float32), indexing="ij"
    )
    return torch.stack([u, v, torch.ones_like(u)]).flatten(1)


def reproject(disparity: Tensor, transform: Tensor, intrinsics: Tensor) -> tuple[Tensor, Tensor]:
    """Where each target pixel is seen in the source view (paper, equation 1, written in disparity, so that points at infinity stay finite).

        p_s ~ K T D(p) K⁻¹ p  =  D(p) · (K R K⁻¹ p + K t / D(p))

    Args:
        disparity: (B, 1, H, W), 1 / depth of the target view, positive.
        transform: (B, 4, 4), target camera → source camera, in the depth's unit.
        intrinsics: (B, 3, 3) in pixels of this size, the same for both views.

    Returns:
        Pixel coordinates (B, H, W, 2) in the source, and (B, 1, H, W) whether the point lies in front of that camera and its
        pixel inside the image.
    """
    batch, _, height, width = disparity.shape
    grid = pixel_grid(height, width, disparity.device)
    homography = intrinsics @ transform[:, :3, :3] @ torch.linalg.inv_ex(intrinsics).inverse
    translation = intrinsics @ transform[:, :3, 3:]
    point = homography @ grid + translation * disparity.reshape(batch, 1, -1)  # (B, 3, H·W)
    z = point[:, 2:]
    pixel = (point[:, :2] / z.clamp(min=MIN_Z)).unflatten(2, (height, width))  # (B, 2, H, W)
    u, v = pixel[:, :1], pixel[:, 1:]
    inside = (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)
    valid = inside & (z > MIN_Z).unflatten(2, (height, width))
    return pixel.permute(0, 2, 3, 1), valid


def sample(image: Tensor, pixel: Tensor) -> Tensor:
    """Bilinear samples (B, C, H, W) of an image (B, C, h, w) at pixel coordinates (B, H, W, 2); outside, the border's value.

    At a coordinate that is not a number it is pixel 0 that is taken: torch's backward on the CPU would read memory that is not its own.
    """
    pixel = torch.where(pixel.isnan(), 0.0, pixel)
    if image.requires_grad and image.device.type == GPU and torch.are_deterministic_algorithms_enabled():
        return gathered(image, pixel)
    size = pixel.new_full((2,), image.shape[-1])
    size[1:].fill_(image.shape[-2])
    normalised = (2.0 * pixel + 1.0) / size - 1.0
    return F.grid_sample(image, normalised, mode="bilinear", padding_mode="border", align_corners=False)


def gathered(image: Tensor, pixel: Tensor) -> Tensor:
    """As `sample`, slower, and on a GPU with a gradient of the image that adds up in a fixed order, as torch's does not."""
    batch, _, height, width = image.shape
    u, v = pixel[..., 0].clamp(0, width - 1), pixel[..., 1].clamp(0, height - 1)  # (B, H, W)
    left, top = u.detach().floor(), v.detach().floor()
    rows = image.permute(0, 2, 3, 1).flatten(0, 2)  # (B·h·w, C)
    first = height * width * torch.arange(batch, device=image.device)[:, None, None]
    across, down = ((left, 1 + left - u), (left + 1, u - left)), ((top, 1 + top - v), (top + 1, v - top))
    result = 0.0
    for (x, share), (y, other) in itertools.product(across, down):
        index = first + width * y.long().clamp(max=height - 1) + x.long().clamp(max=width - 1)
        result = result + (share * other)[..., None] * rows[index]
    return result.permute(0, 3, 1, 2)


def to_unit(images: Tensor) -> Tensor:
    """Bytes → float32 in [0, 1]."""
    return images.float().div_(255.0)


def low_resolution(images: Tensor) -> Tensor:
    """LR-Net's view (…, 3, H/3, W/3): exactly HR-Net's image (…, 3, H, W) averaged 3×3."""
    return F.avg_pool2d(images.flatten(0, -4), 3).unflatten(0, images.shape[:-3])
