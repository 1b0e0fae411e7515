"""The overhead table: what each network costs, and what it gives."""

from collections.abc import Sequence
from typing import Any

import pandas as pd
import torch
from torch import nn

from dualdepth import paper
from dualdepth.evaluation.cost import count, latency
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.dual_net import BothDepths
from dualdepth.results import Run, device_name
from dualdepth.scoring import device
from dualdepth.tables.rows import training_row, with_paper

NETWORKS = {
    "MobileNet V2": (Architecture("single", "mobilenet_v2"), "mobilenet_v2"),
    "ResNet18": (Architecture("single", "resnet18"), "resnet18"),
    "Dual-network (ResNet50)": (Architecture("dual", "resnet50"), "dual"),
    "Dual-network (ResNet50), without LR-Net's decoder": (Architecture("dual", "resnet50"), "dual"),
    "LR-Net (ResNet50)": (Architecture("lr", "resnet50"), "lr"),
}
"""Row: the paper's network, and the variant whose metrics it shows."""


def cost_row(name: str, repeats: int) -> dict[str, Any]:
    """Parameters, operations, time and memory of one inference at the paper's sizes, whatever the profile's; weights are new."""
    architecture, _ = NETWORKS[name]
    net: nn.Module = architecture.build()
    counted, params = net, None
    if architecture.network == "dual":
        counted = BothDepths(net) if "without" not in name else net
        if counted is net:
            params = sum(p.numel() for p in net.parameters()) - sum(p.numel() for p in net.lr_net.decoder.parameters())
    image = torch.rand(1, 3, *paper.RECIPE["lr_size" if architecture.sees_low_resolution else "hr_size"])
    cost = count(counted, image)
    where = torch.device(device())
    counted, image = counted.to(where, memory_format=torch.channels_last), image.to(where)
    row: dict[str, Any] = {"params_m": (params or cost.params) / 1e6, "gmacs": cost.macs / 1e9}
    for precision, suffix in (("float32", ""), ("bf16", "_bf16")):
        measured = latency(counted, image, repeats=repeats, warmup=1, precision=precision)
        row |= {f"latency_ms{suffix}": measured.median_ms, f"peak_mb{suffix}": measured.peak_mb, "device": device_name()}
    return row


def backbone_table(run: Run, seeds: Sequence[int], repeats: int = 3) -> pd.DataFrame:
    """The paper's rows; ours with cost at the paper's sizes and metrics of the profile's trainings; with and without ImageNet weights.

    Columns backbone, params_m (millions), gmacs (10⁹ multiply-accumulates), latency_ms, peak_mb and device (batch 1), the same in bf16,
    the metrics, n, seeds, source, note.
    """
    rows = []
    for name, (_, variant) in NETWORKS.items():
        trained = training_row(run, variant, seeds)
        note = f"cost with a new network at the paper's size; metrics: {trained['note']}"
        rows.append({"backbone": name, **cost_row(name, repeats), **trained, "note": note})
    pretrained = bool(run.profile.training.pretrained)
    without = "no ImageNet weights in this profile: `training.pretrained` is false"
    if pretrained:
        rows += [
            {"backbone": "w/ pt", **training_row(run, "dual", seeds)},
            {"backbone": "w/o pt", **training_row(run, "dual_scratch", seeds)},
        ]
    else:
        rows.append({"backbone": "w/ pt", "variant": "dual", "source": "measured", "note": f"not run: {without}"})
        rows.append({"backbone": "w/o pt", **training_row(run, "dual", seeds)})
    return with_paper("backbone", rows)
