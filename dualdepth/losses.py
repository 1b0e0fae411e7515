"""The paper's losses (section "Loss"), each a mean over the pixels that have at least one valid source view."""

from typing import Any, NamedTuple

import torch
from torch import Tensor
from torch.nn import functional as F

from dualdepth.geometry import pose_matrix, reproject, resize_intrinsics, sample
from dualdepth.settings import Loss

SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2


def ssim(a: Tensor, b: Tensor) -> Tensor:
    """Structural similarity (B·S, C, H, W), at most 1, with the field's 3×3 box window and reflection padding.

    Of images in [0, 1]: `a` (B, C, H, W), and `b` (B·S, C, H, W), S for each of `a`, whose own statistics are then computed once.
    This is monodepth2's and GeoNet's SSIM; kornia's has a Gaussian window, which gives other values.
    """
    views = (len(a), len(b) // len(a))
    product = (a[:, None] * b.unflatten(0, views)).flatten(0, 1)
    mean_a, mean_b = box(a)[:, None], box(b).unflatten(0, views)
    square_a, square_b, product = box(a * a)[:, None], box(b * b).unflatten(0, views), box(product).unflatten(0, views)
    # variances and covariance are means of products less products of means
    means, squares = 2 * mean_a * mean_b, mean_a**2 + mean_b**2
    above = (means + SSIM_C1) * (2 * product - means + SSIM_C2)
    below = (squares + SSIM_C1) * (square_a + square_b - squares + SSIM_C2)
    return (above / below).flatten(0, 1)


class Box(torch.autograd.Function):
    """Means over 3×3 pixels of (B, C, H, W), mirrored at the border.

    Shifted sums, since pooling takes three times as long on a CPU, with a gradient of shifted sums, since that of slices fills an image
    with zeros for each of them.
    """

    @staticmethod
    def forward(ctx: Any, x: Tensor) -> Tensor:
        """The means."""
        x = F.pad(x, (1, 1, 1, 1), mode="reflect")
        x = (x[..., :-2] + x[..., 1:-1]).add_(x[..., 2:])
        return (x[..., :-2, :] + x[..., 1:-1, :]).add_(x[..., 2:, :]).div_(9)

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> Tensor:
        """A pixel counts in the windows around it, and one next to the border twice in the border's window, by the mirror."""
        for dim in (-1, -2):
            size, whole = gradient.shape[dim], gradient.clone()
            whole.narrow(dim, 1, size - 1).add_(gradient.narrow(dim, 0, size - 1))
            whole.narrow(dim, 0, size - 1).add_(gradient.narrow(dim, 1, size - 1))
            whole.select(dim, 1).add_(gradient.select(dim, 0))
            whole.select(dim, -2).add_(gradient.select(dim, -1))
            gradient = whole
        return gradient.div_(9)


box = Box.apply


def photometric_error(target: Tensor, synthesized: Tensor, alpha: float) -> Tensor:
    """α (1 − SSIM)/2 + (1 − α) |I_t − I_s→t|, averaged over channels, in [0, 1] (paper, section "Photometric Loss").

    (B·S, 1, H, W) of targets (B, 3, H, W) in [0, 1] and S synthesized views for each, (B·S, 3, H, W).
    """
    dissimilarity = (1.0 - ssim(target, synthesized)).clamp(0.0, 2.0).mean(dim=1, keepdim=True)
    views = synthesized.unflatten(0, (len(target), -1))
    difference = (target[:, None] - views).abs().mean(dim=2).flatten(0, 1)[:, None]
    return alpha / 2.0 * dissimilarity + (1.0 - alpha) * difference


def feature_error(target: Tensor, synthesized: Tensor) -> Tensor:
    """‖f_t − f_s→t‖₂ over channels: (B, 1, H, W) (paper, section "Feature Reconstruction Loss"); ε keeps the gradient finite at zero."""
    return ((target - synthesized) ** 2).sum(dim=1, keepdim=True).add(1e-8).sqrt()


def minimum_over_sources(errors: Tensor, valid: Tensor) -> tuple[Tensor, Tensor]:
    """Smallest error among the sources that see a pixel: errors and validity (B, S, H, W) → (B, H, W), and where any source sees it.

    Invalid sources cannot be the minimum; it is 0 at a pixel without a valid source.
    """
    seen = valid.any(dim=1)
    return errors.masked_fill(~valid, torch.inf).amin(dim=1).masked_fill(~seen, 0.0), seen


def mean_over_seen(minimum: Tensor, seen: Tensor) -> Tensor:
    """Mean over the pixels that are seen (scalar); without any such pixel it is 0."""
    return minimum.sum() / seen.sum().clamp(min=1)


def smoothness(disparity: Tensor, image: Tensor) -> Tensor:
    """Mean of |∂D| e^−|∂I|, first order, on the disparity divided by its mean (scalar).

    The paper writes depth D, "normalised as in DDVO", which normalises inverse depth; kornia's function does not
    normalise, so the mean is divided out first.
    """
    from kornia.losses import inverse_depth_smoothness_loss

    return inverse_depth_smoothness_loss(disparity / disparity.mean(dim=(2, 3), keepdim=True), image)


def anchor(added: list[Tensor], image: Tensor) -> Tensor:
    """Mean of |r| e^−50t (scalar), beyond the paper: what HR-Net adds to LR-Net's logits, r (B, 1, H/2^s, W/2^s), is to be small where the
    image (B, 3, H, W) in [0, 1] is flat, t = |∂I| averaged over 7×7 pixels; t is about 0.01 on asphalt and sky, 0.05 on facades."""
    down, across = ((image.diff(dim=d, append=image.narrow(d, -1, 1))).abs().mean(dim=1, keepdim=True) for d in (2, 3))
    flat = torch.exp(-50.0 * F.avg_pool2d(down + across, 7, 1, 3, count_include_pad=False))
    return torch.stack([(F.avg_pool2d(flat, 2**s) * r.float().abs()).mean() for s, r in enumerate(added)]).mean()


class Losses(NamedTuple):
    """Total (scalar with gradient), its components before they are weighted, and the finest scale's pictures for the log."""

    total: Tensor
    photometric: Tensor
    smoothness: Tensor
    feature: Tensor
    synthesized: Tensor  # (B, 3, H, W): the first source warped to the target, detached
    error: Tensor  # (B, 1, H, W): minimum photometric error, detached; 0 where no source is valid
    valid_share: Tensor  # of pixels with a valid source


def total_loss(
    images: Tensor,
    intrinsics: Tensor,
    disparities: list[Tensor],
    poses: Tensor,
    settings: Loss,
    features: tuple[Tensor, Tensor] | None = None,
) -> Losses:
    """λ1 L_ph + λ2 L_smooth + λ3 L_fr (paper, section "Loss"), each scale compared at its own size with area-shrunk images.

    Beyond the paper, coarser disparities can be enlarged and compared at the finest size.

    Args:
        images: (B, 1 + S, 3, H, W) in [0, 1], target first.
        intrinsics: (B, 3, 3) at this size.
        disparities: of the target, (B, 1, H/2^s, W/2^s) for s = 0, 1, …
        poses: (B, S, 6), target → source, in the unit of the normalised depth.
        settings: λ1, λ2 (halved at each coarser scale), λ3; α; the mean that the finest disparity is divided to, per image, with gradient
            (DDVO); whether, beyond the paper, the unwarped sources take part in the minimum, and whether all scales compare at full size.
        features: target's (B, C, H, W) and sources' (B, S, C, H, W) for the feature reconstruction loss; None leaves it out.
    """
    images, disparities = images.float(), [d.float() for d in disparities]
    sources, width = images.shape[1] - 1, images.shape[-1]
    transforms = pose_matrix(poses.float()).flatten(0, 1)
    norm = settings.mean_disparity / disparities[0].mean(dim=(2, 3), keepdim=True)
    zero = images.new_zeros(())
    photometric, smooth, feature = zero, zero, zero
    shrunk = images
    for scale, disparity in enumerate(disparities):
        if scale:
            shrunk = F.avg_pool2d(shrunk.flatten(0, 1), 2).unflatten(0, (-1, 1 + sources))
        smooth = smooth + smoothness(disparity, shrunk[:, 0]) * 0.5**scale / len(disparities)
        if settings.beyond_paper_full_resolution:
            disparity = F.interpolate(disparity, images.shape[-2:], mode="bilinear", align_corners=False)
        else:
            images = shrunk
        target, views = images[:, 0], images[:, 1:].flatten(0, 1)  # (B, 3, h, w), (B·S, 3, h, w)
        share = images.shape[-1] / width
        pixel, valid = reproject(
            (disparity * norm).repeat_interleave(sources, 0),
            transforms,
            resize_intrinsics(intrinsics, share, share).repeat_interleave(sources, 0),
        )
        synthesized = sample(views, pixel)
        errors = photometric_error(target, synthesized, settings.alpha).unflatten(0, (-1, sources)).squeeze(2)
        valid = valid.unflatten(0, (-1, sources)).squeeze(2)
        minimum, seen = minimum_over_sources(errors, valid)
        if scale == 0:
            finest = minimum, seen, synthesized.unflatten(0, (-1, sources))[:, 0]
            if features is not None:
                warped = sample(features[1].float().flatten(0, 1), pixel)
                distance = feature_error(features[0].float().repeat_interleave(sources, 0), warped)
                feature = mean_over_seen(*minimum_over_sources(distance.unflatten(0, (-1, sources)).squeeze(2), valid))
        if settings.beyond_paper_automask:
            still = photometric_error(target, views, settings.alpha).unflatten(0, (-1, sources)).squeeze(2)
            minimum, seen = minimum_over_sources(errors, valid & (errors < still.amin(dim=1, keepdim=True)))
        photometric = photometric + mean_over_seen(minimum, seen) / len(disparities)
    minimum, seen, synthesized = finest
    total = settings.photometric * photometric + settings.smoothness * smooth + settings.feature * feature
    return Losses(total, photometric, smooth, feature, synthesized.detach(), minimum[:, None].detach(), seen.float().mean())
