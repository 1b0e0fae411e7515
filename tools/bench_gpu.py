"""A verdict on a GPU in a few minutes, `make bench-gpu`: speed, memory and repeatability of both stages, and the time of the paper's run.

It needs the checkout and torch, OpenCV, pandas, pydantic and kornia, and leaves one JSON and one table, written after each trial.
"""

import argparse
import hashlib
import itertools
import json
import statistics
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pandas as pd
import torch
from torch.utils.data import default_collate

from dualdepth.data.loading import StatelessBatches, TripletDataset, make_loader
from dualdepth.device import choose_device, device_name
from dualdepth.evaluation.cost import latency
from dualdepth.files import write_json, write_text
from dualdepth.networks.depth_nets import LRNet
from dualdepth.networks.pose_net import PoseNet
from dualdepth.profile import Profile, load_profile
from dualdepth.training.loop import total_steps
from dualdepth.training.stages import Stage
from tools.bench import make_net, write_frames

PAPER_TRIPLETS = 39_810  # Of the list eigen_zhou.


@dataclass(frozen=True)
class Trial:
    """What is trained for some steps, and how."""

    stage: str  # `lr` or `hr`
    precision: str = "bf16"
    batch: int = 4
    compiled: bool = False
    again: bool = False  # The same once more, to compare weights bit by bit.


TRIALS = [
    *(Trial(stage, **how) for how in ({}, {"again": True}, {"precision": "float32"}) for stage in ("lr", "hr")),
    *(Trial(stage, batch=batch) for batch in (8, 16) for stage in ("lr", "hr")),
    *(Trial(stage, compiled=True, **how) for how in ({}, {"again": True}) for stage in ("lr", "hr")),
]


def train(trial: Trial, profile: Profile, dataset: TripletDataset, device: torch.device, steps: int) -> dict[str, Any]:
    """Train from new weights on made-up frames for some steps: seconds a step, peak of memory, last loss, digest of the weights."""
    torch.manual_seed(0)
    low = trial.stage == "lr"
    net = LRNet(profile.training.encoder) if low else make_net("dual", profile.training.encoder)
    stage = Stage(net, PoseNet(), profile.training, low=low).to(device, memory_format=torch.channels_last).train()
    trained = [parameter for parameter in stage.parameters() if parameter.requires_grad]
    optimizer = torch.optim.Adam(trained, 2e-4, fused=True)
    if trial.compiled:
        stage.compile(dynamic=False)
    draws = [default_collate([dataset[8 * part, i] for i in range(trial.batch)]) for part in range(4)]
    batches = itertools.cycle([{k: v.to(device) if torch.is_tensor(v) else v for k, v in draw.items()} for draw in draws])
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats()
    times, loss = [time.perf_counter()], torch.zeros(())
    for _, batch in zip(range(steps), batches):
        with torch.autocast(device.type, torch.bfloat16, enabled=trial.precision == "bf16"):
            losses = stage(batch).losses
        optimizer.zero_grad()
        losses.total.backward()
        optimizer.step()
        loss = losses.total.detach().cpu()  # waits for the device
        times.append(time.perf_counter())
    seconds = [after - before for before, after in itertools.pairwise(times)]
    digest = hashlib.sha256()
    for parameter in trained:
        digest.update(parameter.detach().float().cpu().numpy().tobytes())
    return {
        "step_s": statistics.median(seconds[len(seconds) // 3 :]),
        "first_step_s": seconds[0],
        "triplets_per_s": trial.batch / statistics.median(seconds[len(seconds) // 3 :]),
        "peak_gb": torch.cuda.max_memory_allocated() / 1e9 if device.type == "cuda" else None,
        "loss": float(loss),
        "weights": digest.hexdigest()[:16],
    }


def loading(profile: Profile, dataset: TripletDataset, workers: int, batches: int) -> float:
    """Triplets a second from JPEG files to batches, by `workers` processes; the first quarter is not counted."""
    samples = StatelessBatches(len(dataset), profile.training.lr.batch_size, 0, 0, batches)
    times = [time.perf_counter() for _ in make_loader(dataset, samples, workers)]
    counted = times[len(times) // 4 :]
    return profile.training.lr.batch_size * (len(counted) - 1) / (counted[-1] - counted[0])


def verdicts(rows: list[dict[str, Any]], profile: Profile, triplets_per_s: float | None) -> dict[str, Any]:
    """What the trials that were done say: repeatability, ratios, whether the loader keeps up, and hours of the paper's run."""
    of = {Trial(**{name: row[name] for name in Trial.__dataclass_fields__}): row for row in rows if "weights" in row}
    said: dict[str, Any] = {}
    for stage, compiled in itertools.product(("lr", "hr"), (False, True)):
        first, second = (of.get(Trial(stage, compiled=compiled, again=again)) for again in (False, True))
        if first and second:
            said[f"{stage}{', compiled' * compiled}: two runs equal to the bit"] = first["weights"] == second["weights"]
    for stage in ("lr", "hr"):
        base = of.get(Trial(stage))
        for name, other in {"eager / compiled": Trial(stage, compiled=True), "float32 / bf16": Trial(stage, precision="float32")}.items():
            if base and other in of:
                ratio = base["step_s"] / of[other]["step_s"]
                said[f"{stage}: time of a step, {name}"] = ratio if other.compiled else 1 / ratio
        if base:
            said[f"{stage}: hours of the paper's run"] = (
                total_steps(getattr(profile.training, stage), PAPER_TRIPLETS) * base["step_s"] / 3600
            )
        if base and triplets_per_s:
            said[f"{stage}: triplets a second, loader / step"] = triplets_per_s / base["triplets_per_s"]
    return said


def measurements(profile: Profile, device: torch.device, steps: int, workers: int, budget: float) -> Iterator[dict[str, Any]]:
    """All trials, the loader and inference, each as soon as it is done; none begins after `budget` seconds."""
    end = time.monotonic() + budget
    with tempfile.TemporaryDirectory() as folder:
        dataset = TripletDataset([write_frames(Path(folder))] * 64, profile.data.hr_size, profile.training.augmentation, 0)
        for trial in TRIALS:
            if time.monotonic() > end:
                yield asdict(trial) | {"error": f"not begun within {budget:.0f} s"}
                continue
            try:
                yield asdict(trial) | train(trial, profile, dataset, device, steps)
            except (RuntimeError, torch.OutOfMemoryError) as error:  # a verdict on the others is worth more
                yield asdict(trial) | {"error": str(error).partition("\n")[0][:200]}
        yield {"loader": loading(profile, dataset, workers, 4 * steps), "workers": workers}
    image = torch.rand(1, 3, *profile.data.hr_size, device=device)
    for name in ("dual", "resnet18"):
        net = make_net(name, profile.training.encoder).to(device, memory_format=torch.channels_last)
        for precision in ("float32", "bf16"):
            found = latency(net, image, repeats=20, precision=precision)
            yield {"inference": name, "precision": precision, "median_ms": found.median_ms, "peak_mb": found.peak_mb}


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure both stages on a GPU, and say what the paper's run would take.")
    parser.add_argument("--profile", default="paper", help="whose sizes, encoder and steps (default: %(default)s)")
    parser.add_argument("--device", help="default: a GPU where there is one")
    parser.add_argument("--steps", type=int, default=100, help="of each trial (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=16, help="processes of the loader (default: %(default)s)")
    parser.add_argument("--budget", type=float, default=420, metavar="SECONDS", help="no trial begins later (default: %(default)s)")
    parser.add_argument("--out", default="results/bench_gpu", metavar="STEM", help="of the .json and .csv (default: %(default)s)")
    arguments = parser.parse_args(argv)
    device, profile = choose_device(arguments.device), load_profile(arguments.profile)
    torch.use_deterministic_algorithms(True, warn_only=True)  # as a training does
    torch.utils.deterministic.fill_uninitialized_memory = False
    rows: list[dict[str, Any]] = []
    for row in measurements(profile, device, arguments.steps, arguments.workers, arguments.budget):
        rows.append(row)
        print(json.dumps(row), flush=True)
        said = verdicts(rows, profile, next((row["loader"] for row in rows if "loader" in row), None))
        facts = {"device": device_name(), "torch": torch.__version__, "profile": profile.name, "steps": arguments.steps}
        write_json(f"{arguments.out}.json", facts | {"verdicts": said, "rows": rows})
        write_text(f"{arguments.out}.csv", pd.DataFrame(rows).assign(device=device_name()).to_csv(index=False, float_format="%.4g"))
    for what, value in said.items():
        print(f"{what}: {value if isinstance(value, bool) else f'{value:.3g}'}")
    print(f"written to {arguments.out}.json and {arguments.out}.csv")
    return 0


if __name__ == "__main__":
    sys.exit(main())
