"""The losses as slow NumPy readings of the paper: float64, one pixel at a time."""

import numpy as np
import torch

from dualdepth import geometry


def slow_ssim(a, b):
    """SSIM of (H, W) images: 3×3 windows with equal weights, mirrored at the border without repeating it."""
    a, b = np.pad(a, 1, mode="reflect"), np.pad(b, 1, mode="reflect")
    out = np.empty((a.shape[0] - 2, a.shape[1] - 2))
    for i, j in np.ndindex(out.shape):
        p, q = a[i : i + 3, j : j + 3].ravel(), b[i : i + 3, j : j + 3].ravel()
        covariance = np.mean((p - p.mean()) * (q - q.mean()))
        top = (2 * p.mean() * q.mean() + 0.0001) * (2 * covariance + 0.0009)
        out[i, j] = top / ((p.mean() ** 2 + q.mean() ** 2 + 0.0001) * (p.var() + q.var() + 0.0009))
    return out


def slow_photometric(target, other):
    """0.85 (1 − SSIM)/2 + 0.15 |difference|, mean over the channels of (3, H, W)."""
    channels = [0.85 * (1 - slow_ssim(p, q)) / 2 + 0.15 * abs(p - q) for p, q in zip(target, other)]
    return sum(channels) / len(channels)


def slow_smoothness(disparity, image):
    """|∂x D| e^−|∂x I| + |∂y D| e^−|∂y I| of D (H, W) over its mean, |∂I| averaged over channels; each term a mean."""
    d = disparity / disparity.mean()
    x = abs(np.diff(d, axis=1)) * np.exp(-abs(np.diff(image, axis=2)).mean(0))
    y = abs(np.diff(d, axis=0)) * np.exp(-abs(np.diff(image, axis=1)).mean(0))
    return x.mean() + y.mean()


def slow_anchor(added, image):
    """Mean of |r| e^−50t of each r (h, w), where t is |∂I| of I (3, H, W), mean of 7×7 pixels; e^−50t is averaged for smaller r."""
    steep = abs(np.diff(image, axis=1, append=image[:, -1:])).mean(0) + abs(np.diff(image, axis=2, append=image[..., -1:])).mean(0)
    t = [[steep[max(v - 3, 0) : v + 4, max(u - 3, 0) : u + 4].mean() for u in range(steep.shape[1])] for v in range(len(steep))]
    flat = [np.exp(-50 * np.array(t)).reshape(len(r), len(steep) // len(r), r.shape[1], -1).mean((1, 3)) for r in added]
    return np.mean([(f * abs(r)).mean() for f, r in zip(flat, added)])


def slow_warp(image, disparity, numbers, k):
    """Equation 1 and bilinear sampling: (C, H, W) seen from the target, and which pixels are seen at all."""
    out, seen = np.zeros((len(image), *disparity.shape)), np.zeros(disparity.shape, bool)
    height, width = disparity.shape
    rotation = geometry.rotation_matrix(torch.tensor(numbers[3:], dtype=torch.float64)).numpy()  # has its own test
    for v, u in np.ndindex(height, width):
        x, y, z = k @ (rotation @ (np.linalg.inv(k) @ [u, v, 1] / disparity[v, u]) + numbers[:3])
        x, y = x / z, y / z
        seen[v, u] = z > 0 and -0.5 <= x <= width - 0.5 and -0.5 <= y <= height - 0.5
        x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
        c, r = min(int(x), width - 2), min(int(y), height - 2)
        a, b = x - c, y - r
        top = (1 - a) * image[:, r, c] + a * image[:, r, c + 1]
        out[:, v, u] = (1 - b) * top + b * ((1 - a) * image[:, r + 1, c] + a * image[:, r + 1, c + 1])
    return out, seen


def slow_minimum(errors, seen):
    """Mean, over the pixels that some source sees, of the smallest error among the sources that see them."""
    values = []
    for v, u in np.ndindex(errors[0].shape):
        candidates = [error[v, u] for error, s in zip(errors, seen) if s[v, u]]
        if candidates:
            values.append(min(candidates))
    return sum(values) / len(values)


def slow_total(images, k, disparities, poses, features, weights, mean_disparity):
    """The paper's total loss of one item: images (3, 3, H, W), disparities by scale, poses (2, 6), features (3, C, H, W)."""
    factor = mean_disparity / disparities[0].mean()
    photometric = smooth = 0.0
    for s, disparity in enumerate(disparities):
        cell = 2**s
        small = images.reshape(3, 3, images.shape[2] // cell, cell, -1, cell).mean((3, 5))
        k_small = k.copy()
        k_small[:2] /= cell
        k_small[:2, 2] = (k[:2, 2] + 0.5) / cell - 0.5
        warped = [slow_warp(small[1 + i], disparity * factor, poses[i], k_small) for i in range(2)]
        photometric += slow_minimum([slow_photometric(small[0], w) for w, _ in warped], [s for _, s in warped]) / len(disparities)
        smooth += slow_smoothness(disparity, small[0]) / cell / len(disparities)
    warped = [slow_warp(features[1 + i], disparities[0] * factor, poses[i], k) for i in range(2)]
    feature = slow_minimum([np.sqrt(((features[0] - w) ** 2).sum(0)) for w, _ in warped], [s for _, s in warped])
    return weights[0] * photometric + weights[1] * smooth + weights[2] * feature, photometric, smooth, feature
