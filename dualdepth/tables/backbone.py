"""The overhead table: what each network costs, and what it gives."""

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
import torch
from torch import nn

from dualdepth import paper
from dualdepth.device import default_device, device_name, has_bf16
from dualdepth.evaluation.cost import Latency, count, latency
from dualdepth.geometry import low_resolution
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.depth_nets import DualNet
from dualdepth.run import Run
from dualdepth.tables.rows import MEASURED, method_row, not_run, with_paper
from dualdepth.tables.scores import Scores, collect, scored

NO_WEIGHTS = "no ImageNet weights in this profile: `training.pretrained` is false"
WITHOUT_DECODER = "Dual-network (ResNet50), without LR-Net's decoder"
NETWORKS = {
    "MobileNet V2": (Architecture(network="single", encoder="mobilenet_v2"), "mobilenet_v2"),
    "ResNet18": (Architecture(network="single", encoder="resnet18"), "resnet18"),
    "Dual-network (ResNet50)": (Architecture(network="dual", encoder="resnet50"), "dual"),
    WITHOUT_DECODER: (Architecture(network="dual", encoder="resnet50"), "dual"),
    "LR-Net (ResNet50)": (Architecture(network="lr", encoder="resnet50"), "lr"),
}
"""Row: the paper's network, and the variant whose metrics it shows."""


@torch.no_grad()
def let_see(net: nn.Module, image: torch.Tensor) -> nn.Module:
    """Give a network with new weights the statistics of an image (B, 3, H, W), and SA-Attention its starting scale, as a training begins.

    SA-Attention is cubic in LR-Net's features: in a network that saw nothing numbers run over, and ELU takes five times as long on these.
    """
    for layer in net.modules():
        if isinstance(layer, nn.BatchNorm2d):
            layer.momentum = 1.0
    if isinstance(net, DualNet):
        net.lr_net.encoder.train()(low_resolution(image))
        net.lr_net.eval()
        net.begin(image)
    net.train()(image)
    return net.eval()


def cost_row(name: str, repeats: int) -> dict[str, Any]:
    """Parameters, operations, time and memory of one inference at the paper's sizes, whatever the profile's; weights are new, `let_see`.

    Time and memory in bf16 are NaN on a device that only imitates it.
    """
    architecture, _ = NETWORKS[name]
    image = torch.rand(1, 3, *(paper.LR_SIZE if architecture.sees_low_resolution else paper.HR_SIZE))
    net = let_see(architecture.build(), image)
    # the paper counts LR-Net's decoder, which depth at high resolution does not need
    options = {"with_lr_depth": True} if architecture.network == "dual" and name != WITHOUT_DECODER else {}
    if name == WITHOUT_DECODER:
        net.lr_net.decoder = nn.Identity()
    cost, where = count(net, image, **options), default_device()
    net, image = net.to(where, memory_format=torch.channels_last), image.to(where)
    row: dict[str, Any] = {"params_m": cost.params / 1e6, "gmacs": cost.macs / 1e9, "device": device_name()}
    for precision, suffix in (("float32", ""), ("bf16", "_bf16")):
        there = precision == "float32" or has_bf16(where)
        found = latency(net, image, repeats=repeats, precision=precision, **options) if there else Latency(math.nan, math.nan)
        row |= {f"latency_ms{suffix}": found.median_ms, f"peak_mb{suffix}": found.peak_mb}
    return row


def backbone_scores(run: Run, seeds: Sequence[int]) -> Scores:
    """Scores of the table's trainings; `dual_scratch` is another only where the others begin with ImageNet weights."""
    scores = collect(run, (*(variant for _, variant in NETWORKS.values()), "dual_scratch"), seeds)
    return scores if run.profile.training.pretrained else scores._replace(missing=scores.missing | {"dual_scratch": NO_WEIGHTS})


def backbone_table(run: Run, scores: Scores, repeats: int = 3) -> pd.DataFrame:
    """The paper's rows; ours with cost at the paper's sizes and metrics of the profile's trainings; with and without ImageNet weights.

    Columns backbone, params_m (millions), gmacs (10⁹ multiply-accumulates), latency_ms, peak_mb and device (batch 1), the same in bf16,
    the metrics, n, source, seeds, note, reason (why there are no metrics), leak.
    """
    rows = []
    imitated = "" if has_bf16(default_device()) else ", bf16 not measured: the device only imitates it"
    cost = f"cost of a new network at the paper's size{imitated}"
    for name, (_, variant) in NETWORKS.items():
        row = method_row(scores, variant, note=scored(run).note)
        note = "; ".join([cost, *([f"metrics of variant {variant}: {row['note']}"] if "note" in row else [])])
        rows.append({"backbone": name, **cost_row(name, repeats), **row, "source": MEASURED, "note": note})
    pretrained, note = run.profile.training.pretrained, scored(run).note
    begun = method_row(scores, "dual", note=note) if pretrained else {"variant": "dual", **not_run(NO_WEIGHTS)}
    new = method_row(scores, "dual_scratch" if pretrained else "dual", note=note)
    return with_paper("backbone", [*rows, {"backbone": "w/ pt", **begun}, {"backbone": "w/o pt", **new}])
