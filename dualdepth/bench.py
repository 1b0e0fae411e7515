"""Speed, measured in one run on the machine at hand: `make bench`. Quote ratios and medians, not single times."""

import argparse
import statistics
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pandas as pd
import torch
from torch.utils.data import default_collate
from tqdm import tqdm

from dualdepth.atomic import write_text
from dualdepth.config import Profile, load_profile
from dualdepth.data.loading import TripletDataset
from dualdepth.data.triplets import Triplet
from dualdepth.networks.lr_net import LRNet
from dualdepth.stages import LRStage

RAW_SIZE = (375, 1242)
"""KITTI's frames, (height, width)."""


def median_seconds(action: Callable[[], Any], repeats: int, warmup: int = 1) -> float:
    """Median wall time of `action`, after some calls that do not count."""
    times = []
    for _ in range(warmup + repeats):
        began = time.perf_counter()
        action()
        if torch.cuda.is_available():
            torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
    return statistics.median(times[warmup:])


def write_frames(folder: Path) -> Triplet:
    """Three JPEG frames of KITTI's size (quality 92, as the field stores them): a smooth scene with noise, hard enough to decode."""
    rng = np.random.default_rng(0)
    scene = cv2.resize(rng.integers(0, 255, (47, 156, 3), np.uint8), RAW_SIZE[::-1], interpolation=cv2.INTER_CUBIC)
    paths = []
    for number in range(3):
        frame = np.roll(scene, 4 * number, axis=1).astype(np.int16) + rng.integers(-12, 12, scene.shape)
        paths.append(folder / f"{number:010d}.jpg")
        cv2.imwrite(str(paths[-1]), frame.clip(0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, 92])
    return Triplet("bench", (paths[1], paths[0], paths[2]), np.array([[721.5, 0, 609.6], [0, 721.5, 172.9], [0, 0, 1.0]]))


class StepTimer:
    """Times the parts of a training step of a stage: networks, losses, backward, optimiser."""

    def __init__(self, profile: Profile, device: torch.device) -> None:
        torch.manual_seed(0)
        self.stage = LRStage(profile).to(device)
        if profile.training.channels_last:
            self.stage = self.stage.to(memory_format=torch.channels_last)
        self.optimizer = torch.optim.Adam(self.stage.parameters(), 1e-4)
        self.device, self.bf16 = device, profile.training.precision == "bf16"
        self.networks = 0.0
        for net in (self.stage.depth_net, self.stage.pose_net):
            net.register_forward_pre_hook(lambda *_: self._mark(-1))
            net.register_forward_hook(lambda *_: self._mark(1))

    def _now(self) -> float:
        if self.device.type == "cuda":
            torch.cuda.synchronize()
        return time.perf_counter()

    def _mark(self, sign: int) -> None:
        self.networks += sign * self._now()

    def step(self, batch: dict[str, Any]) -> dict[str, float]:
        """Seconds of one step by part."""
        self.networks = 0.0
        began = self._now()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.bf16):
            output = self.stage(batch)
        forward = self._now()
        self.optimizer.zero_grad()
        output.losses.total.backward()
        backward = self._now()
        self.optimizer.step()
        done = self._now()
        parts = {"networks": self.networks, "losses": forward - began - self.networks}
        return parts | {"backward": backward - forward, "optimiser": done - backward, "step": done - began}


def median_step(profile: Profile, batch: dict[str, Any], device: torch.device, repeats: int) -> dict[str, float]:
    """Median seconds of a step's parts."""
    timer = StepTimer(profile, device)
    rows = [timer.step(batch) for _ in range(repeats + 2)][2:]
    return {part: statistics.median(row[part] for row in rows) for part in rows[0]}


def bench(encoder: str, repeats: int) -> pd.DataFrame:
    """All measurements: columns what, value, unit."""
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    base = load_profile("paper")
    training = base.training.model_copy(update={"encoder": encoder, "pretrained": False})
    profile = base.model_copy(update={"training": training})
    rows: list[tuple[str, float, str]] = []
    with tempfile.TemporaryDirectory() as folder, tqdm(total=4, desc="measuring", unit="part") as bar:
        dataset = TripletDataset([write_frames(Path(folder))], profile.data.hr_size, training.augmentation, 0)
        cv2.setNumThreads(1)
        load = median_seconds(lambda: dataset[0, 0], 10 * repeats)
        cv2.setNumThreads(-1)
        rows.append(("loader, one core: JPEG 1242x375 to HR tensors 384x1248", 1 / load, "triplets/s"))
        bar.update()
        batch = default_collate([dataset[epoch, 0] for epoch in range(training.lr.batch_size)])
        batch = {k: v.to(device) if torch.is_tensor(v) else v for k, v in batch.items()}
        steps = {}
        for precision in ("bf16", "float32"):
            setting = training.model_copy(update={"precision": precision})
            steps[precision] = median_step(profile.model_copy(update={"training": setting}), batch, device, repeats)
            bar.update()
        chosen = steps["bf16"]
        rows.append((f"stage 1 step, {encoder} 128x416, batch 4, bf16", chosen["step"], "s"))
        rows += [(f"  of it {part}", chosen[part] / chosen["step"], "share") for part in ("networks", "losses", "backward", "optimiser")]
        rows.append(("  float32 step / bf16 step", steps["float32"]["step"] / chosen["step"], "ratio"))
        rows.append(("  loading a batch on one core / step", load * training.lr.batch_size / chosen["step"], "ratio"))
        net = LRNet(encoder).eval().to(device)
        image = torch.rand(1, 3, *profile.data.lr_size, device=device)
        with torch.inference_mode():
            rows.append((f"inference, {encoder} 128x416, float32", 1e3 * median_seconds(lambda: net(image, scales=1), repeats, 3), "ms"))
        bar.update()
    name = torch.cuda.get_device_name() if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
    return pd.DataFrame(rows, columns=["what", "value", "unit"]).assign(device=name)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure loader, training step and inference.")
    parser.add_argument("--encoder", default="resnet18", help="LR-Net's encoder (default: %(default)s)")
    parser.add_argument("--repeats", type=int, default=5, help="counted runs of each step (default: %(default)s)")
    parser.add_argument("--out", default="results/bench.csv", metavar="FILE", help="(default: %(default)s)")
    arguments = parser.parse_args(argv)
    table = bench(arguments.encoder, arguments.repeats)
    write_text(arguments.out, table.to_csv(index=False, float_format="%.4g"))
    print(table.to_string(index=False, float_format=lambda value: f"{value:.3g}"))
    print(f"written to {arguments.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
