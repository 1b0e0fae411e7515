"""Why are slim poles not seen on `miniature`: does the objective not want them, or is the training too short?

    python experiments/poles.py objective      # a minute
    python experiments/poles.py teacher        # an hour on one core

Both render streets that are used nowhere else. `objective` moves the poles in the exact depth, step by step, from their background's depth
to their own, and prints what becomes of the losses. `teacher` trains LR-Net and then HR-Net with exact depth instead of view synthesis,
and prints the depth errors of poles.
"""

import argparse
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F
from tqdm import tqdm

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from data_scripts.miniature import formats
from data_scripts.miniature.drives import PERIOD, drive
from data_scripts.miniature.plan import RAW
from data_scripts.miniature.render import render_geometry, render_image
from data_scripts.miniature.scene import build_scene
from data_scripts.miniature.street import Plan, build_street
from dualdepth.config import Profile, load_profile
from dualdepth.evaluation.objects import POLE
from dualdepth.geometry import reproject, resize_intrinsics, sample
from dualdepth.losses import mean_of_minimum, photometric_error, smoothness
from dualdepth.memory import keep_freed_memory
from dualdepth.networks.dual_net import DualNet
from dualdepth.networks.lr_net import LRNet

TESTED, TAUGHT = 3003, 4004
"""Seeds of streets."""
FARTHEST = 80.0


class Shot(NamedTuple):
    """A moment at the HR size: (3, 3, H, W) target, previous and next frame in bytes; exact depth, 0 in the sky, and labels (H, W)."""

    images: np.ndarray
    depth: np.ndarray
    labels: np.ndarray
    intrinsics: np.ndarray
    transforms: np.ndarray
    """(2, 4, 4) target → source."""


def shots(profile: Profile, seed: int, streets: int, moments: range) -> Iterator[Shot]:
    """Render moments of some streets."""
    world, size = profile.world, profile.data.hr_size
    matrix = resize_intrinsics(torch.from_numpy(formats.intrinsics(world.size)), size[1] / world.size[1], size[0] / world.size[0]).numpy()
    for number in tqdm(range(streets), desc="rendering streets"):
        frames = moments.stop + 2
        length = 1.3 * frames * world.frame_spacing + 10
        plan = Plan((seed, RAW, number), length, bend=0.45, wavelength=180.0, pace=world.frame_spacing / PERIOD)
        ride, scene = drive(plan, build_street(plan), world.frame_spacing, frames), build_scene(plan)
        for k in moments:
            images = [render_image(scene, ride.poses[j], matrix, size, world.supersample, ride.times[j]) for j in (k, k - 1, k + 1)]
            depth, labels, _ = render_geometry(scene, ride.poses[k], matrix, size, ride.times[k])
            transforms = np.stack([np.linalg.inv(ride.poses[j]) @ ride.poses[k] for j in (k - 1, k + 1)])
            yield Shot(np.stack(images).transpose(0, 3, 1, 2), depth, labels, matrix, transforms)


def behind_poles(disparity: np.ndarray, pole: np.ndarray) -> np.ndarray:
    """Disparity (H, W) with each pixel of a pole at the farther of its row's nearest pixels beside the pole."""
    out, wide = disparity.copy(), cv2.dilate(pole.astype(np.uint8), np.ones((1, 3))) > 0
    for y, x in zip(*np.nonzero(pole)):
        beside = np.nonzero(~wide[y])[0]
        place = np.searchsorted(beside, x)
        out[y, x] = disparity[y, beside[[max(place - 1, 0), min(place, len(beside) - 1)]]].min()
    return out


def objective(profile: Profile) -> None:
    """Print photometric loss and smoothness as the poles come out of their background."""
    found = list(shots(profile, TESTED, 6, range(6, 31, 8)))
    images = torch.from_numpy(np.stack([s.images for s in found])).float() / 255
    matrix = torch.from_numpy(np.stack([s.intrinsics for s in found])).float()
    transforms = torch.from_numpy(np.stack([s.transforms for s in found])).float().flatten(0, 1)
    exact = np.stack([np.where(s.depth > 0, 1 / np.maximum(s.depth, 1e-6), 1e-3) for s in found]).astype(np.float32)
    behind = np.stack([behind_poles(d, s.labels == POLE) for d, s in zip(exact, found)])
    loss, first = profile.training.loss, None
    for share in (0.0, 0.1, 0.2, 0.3, 0.5, 0.7, 0.85, 1.0):
        disparity, views = torch.from_numpy(behind + (exact - behind) * share)[:, None], images
        photometric, smooth = 0.0, 0.0
        for scale in range(loss.scales):
            if scale:
                views, disparity = F.avg_pool2d(views.flatten(0, 1), 2).unflatten(0, (-1, 3)), F.avg_pool2d(disparity, 2)
            pixel, valid = reproject(
                disparity.repeat_interleave(2, 0), transforms, resize_intrinsics(matrix, 0.5**scale, 0.5**scale).repeat_interleave(2, 0)
            )
            errors = photometric_error(views[:, 0], sample(views[:, 1:].flatten(0, 1), pixel), loss.alpha)
            photometric += mean_of_minimum(errors.unflatten(0, (-1, 2))[:, :, 0], valid.unflatten(0, (-1, 2))[:, :, 0]).item() / loss.scales
            smooth += smoothness(disparity, views[:, 0]).item() * 0.5**scale / loss.scales
        first = first or (photometric, smooth)
        gain, price = first[0] - photometric, loss.smoothness * (smooth - first[1])
        back = price / gain if gain else 0.0
        print(f"{share:.0%} of the way: L_ph {photometric:.5f}, {gain / first[0]:.1%} less; λ2 L_smooth takes back {back:.1%}")


def teacher(profile: Profile) -> None:
    """Train with exact depth, LR-Net for 1000 steps and HR-Net for as many as the profile does; print errors of all pixels and of poles."""
    keep_freed_memory()
    taught = list(shots(profile, TAUGHT, profile.world.train_drives, range(1, 98)))
    tested = list(shots(profile, TESTED, 6, range(6, 31, 8)))
    per_epoch = len(taught) // profile.training.hr.batch_size
    torch.manual_seed(0)
    net = LRNet(profile.training.encoder, False)
    learn(net, taught, 3, 1000)
    print("LR-Net:", *errors_of(net, tested, 3))
    dual = DualNet(net)
    learn(dual, taught, 1, profile.training.hr.epochs * per_epoch)
    print("LR-Net + HR-Net, with SA:", *errors_of(dual, tested, 1))


def learn(net: nn.Module, taught: list[Shot], shrink: int, steps: int) -> None:
    """Minimise |log depth − log exact depth| at all scales; `shrink` is how much smaller than the HR size the network's input is."""
    optimizer = torch.optim.Adam([p for p in net.parameters() if p.requires_grad], 2e-4)
    rng = np.random.default_rng(0)
    net.train().to(memory_format=torch.channels_last)
    for _ in tqdm(range(steps), desc=type(net).__name__, unit="step"):
        chosen = [taught[k] for k in rng.choice(len(taught), 4, replace=False)]
        depth = torch.from_numpy(np.stack([s.depth for s in chosen]))[:, None]
        known, inverse = ((depth > 0) & (depth < FARTHEST)).float(), torch.where(depth > 0, 10 / depth.clamp(min=1e-3), 0.05)
        with torch.autocast("cpu", torch.bfloat16):
            output = net(network_input(chosen, shrink))
        loss = torch.zeros(())
        for scale, disparity in enumerate(output.disparities):
            weight, wanted = (F.avg_pool2d(x, shrink * 2**scale) for x in (known, inverse))
            loss = loss + ((disparity.float().log() - wanted.log()).abs() * weight).sum() / weight.sum()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()


def network_input(chosen: list[Shot], shrink: int) -> Tensor:
    """(B, 3, H / shrink, W / shrink) in [0, 1]."""
    images = torch.from_numpy(np.stack([s.images[0] for s in chosen])).float() / 255
    return F.avg_pool2d(images, shrink).contiguous(memory_format=torch.channels_last)


@torch.no_grad()
def errors_of(net: nn.Module, tested: list[Shot], shrink: int) -> Iterator[str]:
    """Mean over images of Abs Rel and δ<1.25, after median scaling, of all pixels and of poles."""
    net.eval()
    rows: dict[str, list[tuple[float, float]]] = {"all": [], "poles": []}
    for shot in tested:
        disparity = net(network_input([shot], shrink), 1).disparities[0]
        depth = F.interpolate(1 / disparity, size=shot.depth.shape, mode="bilinear", align_corners=False)[0, 0].numpy()
        seen = (shot.depth > 0) & (shot.depth < FARTHEST)
        depth = depth * np.median(shot.depth[seen]) / np.median(depth[seen])
        for name, mask in (("all", seen), ("poles", seen & (shot.labels == POLE))):
            truth, ratio = shot.depth[mask], np.maximum(shot.depth[mask] / depth[mask], depth[mask] / shot.depth[mask])
            rows[name].append((float((abs(depth[mask] - truth) / truth).mean()), float((ratio < 1.25).mean())))
    for name, values in rows.items():
        abs_rel, a1 = np.mean(values, 0)
        yield f"{name}: Abs Rel {abs_rel:.3f}, δ<1.25 {a1:.3f};"


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("part", choices=["objective", "teacher"])
    {"objective": objective, "teacher": teacher}[parser.parse_args().part](load_profile("miniature"))
