"""The overhead table: what each network costs, and what it gives."""

import math
from collections.abc import Sequence
from typing import Any

import pandas as pd
import torch
from torch import nn

from dualdepth import paper
from dualdepth.device import default_device, device_name, has_bf16
from dualdepth.evaluation.cost import count, latency
from dualdepth.networks.architecture import Architecture
from dualdepth.run import Run
from dualdepth.tables.rows import compare_trainings, training_row, with_paper

WITHOUT_DECODER = "Dual-network (ResNet50), without LR-Net's decoder"
NETWORKS = {
    "MobileNet V2": (Architecture(network="single", encoder="mobilenet_v2"), "mobilenet_v2"),
    "ResNet18": (Architecture(network="single", encoder="resnet18"), "resnet18"),
    "Dual-network (ResNet50)": (Architecture(network="dual", encoder="resnet50"), "dual"),
    WITHOUT_DECODER: (Architecture(network="dual", encoder="resnet50"), "dual"),
    "LR-Net (ResNet50)": (Architecture(network="lr", encoder="resnet50"), "lr"),
}
"""Row: the paper's network, and the variant whose metrics it shows."""


def cost_row(name: str, repeats: int) -> dict[str, Any]:
    """Parameters, operations, time and memory of one inference at the paper's sizes, whatever the profile's; weights are new.

    Time and memory in bf16 are NaN on a device that only imitates it.
    """
    architecture, _ = NETWORKS[name]
    net: nn.Module = architecture.build()
    # the paper counts LR-Net's decoder, which depth at high resolution does not need
    options = {"with_lr_depth": True} if architecture.network == "dual" and name != WITHOUT_DECODER else {}
    if name == WITHOUT_DECODER:
        net.lr_net.decoder = nn.Identity()
    image = torch.rand(1, 3, *paper.RECIPE["lr_size" if architecture.sees_low_resolution else "hr_size"])
    cost, where = count(net, image, **options), default_device()
    net, image = net.to(where, memory_format=torch.channels_last), image.to(where)
    row: dict[str, Any] = {"params_m": cost.params / 1e6, "gmacs": cost.macs / 1e9, "device": device_name()}
    for precision, suffix in (("float32", ""), ("bf16", "_bf16")):
        row |= {f"latency_ms{suffix}": math.nan, f"peak_mb{suffix}": math.nan}
        if precision == "float32" or has_bf16(where):
            measured = latency(net, image, repeats=repeats, precision=precision, **options)
            row |= {f"latency_ms{suffix}": measured.median_ms, f"peak_mb{suffix}": measured.peak_mb}
    return row


def backbone_table(run: Run, seeds: Sequence[int], repeats: int = 3) -> pd.DataFrame:
    """The paper's rows; ours with cost at the paper's sizes and metrics of the profile's trainings; with and without ImageNet weights.

    Columns backbone, params_m (millions), gmacs (10⁹ multiply-accumulates), latency_ms, peak_mb and device (batch 1), the same in bf16,
    the metrics, n, seeds, source, note.
    """
    rows = []
    imitated = "" if has_bf16(default_device()) else ", bf16 not measured: the device only imitates it"
    for name, (_, variant) in NETWORKS.items():
        trained = training_row(run, variant, seeds)
        note = f"cost of a new network at the paper's size{imitated}; metrics of variant {variant}: {trained['note']}"
        rows.append({"backbone": name, **cost_row(name, repeats), **trained, "note": note})
    if run.profile.training.pretrained:
        begun, new = training_row(run, "dual", seeds), training_row(run, "dual_scratch", seeds)
    else:
        note = "not run: no ImageNet weights in this profile: `training.pretrained` is false"
        begun, new = {"variant": "dual", "source": "measured", "note": note}, training_row(run, "dual", seeds)
    return with_paper("backbone", [*rows, {"backbone": "w/ pt", **begun}, {"backbone": "w/o pt", **new}])


CLAIMS = {
    ("dual", "resnet18"): "the dual network is better than ResNet18 at high resolution",
    ("dual", "mobilenet_v2"): "the dual network is better than MobileNet V2 at high resolution",
    ("dual", "dual_scratch"): "ImageNet weights help",
}
"""(better, worse) as the paper has it, and its claim."""


def backbone_claims(run: Run, seeds: Sequence[int]) -> pd.DataFrame:
    """The paper's claims about backbones, paired. Single networks begin with a new PoseNet, the dual one after a whole stage 1."""
    pairs = [pair for pair in CLAIMS if pair[1] != "dual_scratch" or run.profile.training.pretrained]
    table = compare_trainings(run, pairs, seeds)
    if len(pairs) < len(CLAIMS):
        reason = "not run: no ImageNet weights in this profile"
        table = pd.concat([table, pd.DataFrame([{"a": "dual", "b": "dual_scratch", "metric": "", "in_words": reason}])], ignore_index=True)
    table.insert(0, "claim", [CLAIMS[pair] for pair in zip(table["a"], table["b"])])
    return table
