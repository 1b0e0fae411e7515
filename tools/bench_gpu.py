"""A verdict on a GPU in a few minutes, `make bench-gpu`: speed, memory and repeatability of both stages, and the time of the paper's run.

It needs no data, only the packages that a training needs, and leaves one JSON and one table, written anew after each trial.
"""

import argparse
import gc
import hashlib
import itertools
import json
import math
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
from dualdepth.device import choose_device, compute_repeatably
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.evaluation.cost import latency
from dualdepth.files import write_json, write_text
from dualdepth.geometry import to_unit
from dualdepth.networks.depth_nets import LRNet
from dualdepth.networks.pose_net import PoseNet
from dualdepth.profile import Profile, load_profile
from dualdepth.tables.backbone import let_see
from dualdepth.training.loop import total_steps
from dualdepth.training.stages import Stage
from tools.bench import make_net, write_frames

PAPER_TRIPLETS = 39_810  # Of the list eigen_zhou.
FEWEST = 6  # Steps of a trial that is cut short.


@dataclass(frozen=True)
class Trial:
    """What is trained for some steps, and how."""

    stage: str  # `lr` or `hr`
    precision: str = "bf16"
    batch: int = 4
    compiled: bool = False
    deterministic: bool = True
    again: bool = False  # The same once more, to compare weights bit by bit.


TRIALS = [
    *(Trial(stage, **how) for how in ({}, {"again": True}, {"precision": "float32"}) for stage in ("lr", "hr")),
    *(Trial(stage, compiled=True, **how) for how in ({}, {"again": True}) for stage in ("lr", "hr")),
    *(Trial(stage, deterministic=False) for stage in ("lr", "hr")),
    *(Trial(stage, batch=batch) for batch in (8, 16) for stage in ("lr", "hr")),
]


class Bench:
    """Trials of a profile on a device, from new weights on made-up frames; none goes on for long after `end` (monotonic seconds)."""

    def __init__(self, profile: Profile, device: torch.device, steps: int, end: float, folder: str) -> None:
        self.profile, self.device, self.steps, self.end = profile, device, steps, end
        self.dataset = TripletDataset([write_frames(Path(folder))] * 64, profile.data.hr_size, profile.training.augmentation, 0)
        self.lr_net = LRNet(profile.training.encoder).state_dict()
        """Of the first trial of stage 1, once it is done: stage 2 begins from a network that saw images."""

    def train(self, trial: Trial) -> dict[str, Any]:
        """Seconds of a step, peak of memory, the depth network's last gradient, which must not be none, and a digest of the weights.

        A step is as in a training, but for checks that numbers are finite, and frames that are on the device before it begins.
        """
        compute_repeatably(trial.deterministic)  # as a training does
        if trial.compiled:
            torch.compiler.reset()
        gc.collect()  # a compiled network holds itself
        if self.device.type == "cuda":
            torch.cuda.empty_cache()
            torch.cuda.reset_peak_memory_stats(self.device)
        draws = [default_collate([self.dataset[part, i] for i in range(trial.batch)]) for part in range(4)]
        stage = self.stage(trial, to_unit(draws[0]["images"][:, 0]))
        trained = [parameter for parameter in stage.parameters() if parameter.requires_grad]
        optimizer = torch.optim.Adam(trained, 2e-4, fused=True)
        if trial.compiled:
            stage.compile(dynamic=False)
        batches = itertools.cycle([{k: v.to(self.device) if torch.is_tensor(v) else v for k, v in draw.items()} for draw in draws])
        times, loss = [time.perf_counter()], math.nan
        for step, batch in zip(range(self.steps), batches):
            with torch.autocast(self.device.type, torch.bfloat16, enabled=trial.precision == "bf16"):
                losses = stage(batch).losses
            optimizer.zero_grad()
            losses.total.backward()
            optimizer.step()
            loss = losses.total.item()  # waits for the device
            times.append(time.perf_counter())
            if step >= FEWEST and time.monotonic() > self.end:
                break
        seconds = [after - before for before, after in itertools.pairwise(times)]
        gradient = float(torch.nn.utils.get_total_norm(p.grad for p in stage.depth_net.parameters() if p.grad is not None))
        if not math.isfinite(loss) or not 0 < gradient < math.inf:
            raise RuntimeError(f"nothing is learned: loss {loss}, gradient {gradient} after {len(seconds)} steps")
        digest = hashlib.sha256()
        for parameter in trained:
            digest.update(parameter.detach().float().cpu().numpy().tobytes())
        if trial == Trial("lr"):
            self.lr_net = {name: tensor.cpu() for name, tensor in stage.depth_net.state_dict().items()}
        step_s = statistics.median(seconds[len(seconds) // 3 :])
        peak = torch.cuda.max_memory_allocated(self.device) / 1e9 if self.device.type == "cuda" else None
        found = {"step_s": step_s, "first_step_s": seconds[0], "triplets_per_s": trial.batch / step_s, "steps": len(seconds)}
        return found | {"peak_gb": peak, "loss": loss, "gradient": gradient, "weights": digest.hexdigest()[:16]}

    def stage(self, trial: Trial, image: torch.Tensor) -> Stage:
        """What a trial trains."""
        torch.manual_seed(0)
        low = trial.stage == "lr"
        net = LRNet(self.profile.training.encoder) if low else make_net("dual", self.profile.training.encoder)
        if not low:
            net.lr_net.load_state_dict(self.lr_net)
            net.begin(image)
        stage = Stage(net, PoseNet(), self.profile.training, low=low).to(self.device)
        return stage.to(memory_format=torch.channels_last).train()

    def loading(self, workers: int, batches: int) -> dict[str, Any]:
        """Triplets a second from JPEG files to batches, by at most so many processes; the first quarter is not counted."""
        loader = make_loader(self.dataset, StatelessBatches(len(self.dataset), 4, 0, 0, batches), workers)
        times = [time.perf_counter() for _ in loader]
        counted = times[len(times) // 4 :]
        return {"loader_triplets_per_s": 4 * (len(counted) - 1) / (counted[-1] - counted[0]), "workers": loader.num_workers}

    def inference(self, name: str, precision: Any) -> dict[str, Any]:
        """Time and memory of one image, as `predict` computes it."""
        compute_repeatably(False)
        image = torch.rand(1, 3, *self.profile.data.hr_size)
        net = let_see(make_net(name, self.profile.training.encoder), image).to(self.device, memory_format=torch.channels_last)
        found = latency(net, image.to(self.device), repeats=20, precision=precision)
        return {"inference": name, "precision": precision} | found._asdict()

    def run(self, workers: int) -> Iterator[dict[str, Any]]:
        """All measurements, each as soon as it is made; one that fails says why."""
        works = [(asdict(trial), lambda trial=trial: self.train(trial)) for trial in TRIALS]
        works.insert(2, ({}, lambda: self.loading(workers, 2 * self.steps)))
        for name, precision in itertools.product(("dual", "resnet18"), ("float32", "bf16")):
            works.insert(3, ({}, lambda name=name, precision=precision: self.inference(name, precision)))
        for row, work in works:
            try:
                if time.monotonic() > self.end:
                    raise TimeoutError("not begun in time; raise --budget")
                yield row | work()
            except Exception as error:  # a verdict on the others is worth more
                yield row | {"error": f"{type(error).__name__}: {str(error).partition(chr(10))[0][:200]}"}


def verdicts(rows: list[dict[str, Any]], profile: Profile) -> dict[str, Any]:
    """What the trials that were done say: repeatability, ratios, whether the loader keeps up, and hours of the profile's run."""
    of = {Trial(**{name: row[name] for name in Trial.__dataclass_fields__}): row for row in rows if "weights" in row}
    loader = next((row["loader_triplets_per_s"] for row in rows if "loader_triplets_per_s" in row), None)
    said: dict[str, Any] = {}
    for stage, compiled in itertools.product(("lr", "hr"), (False, True)):
        first, second = (of.get(Trial(stage, compiled=compiled, again=again)) for again in (False, True))
        if first and second and first["steps"] == second["steps"]:
            said[f"{stage}{', compiled' * compiled}: two runs equal to the bit"] = first["weights"] == second["weights"]
    for stage in ("lr", "hr"):
        base, settings = of.get(Trial(stage)), getattr(profile.training, stage)
        if not base:
            continue
        others = {"eager / compiled": Trial(stage, compiled=True), "bf16 / float32": Trial(stage, precision="float32")}
        others["deterministic / not"] = Trial(stage, deterministic=False)
        for what, other in others.items():
            if other in of:
                said[f"{stage}: time of a step, {what}"] = base["step_s"] / of[other]["step_s"]
        training = profile.training
        as_timed = not (
            training.beyond_paper_residual or training.beyond_paper_pose_encoder or training.beyond_paper_refined_after is not None
        )
        if as_timed and settings.batch_size == Trial(stage).batch:
            seconds = total_steps(settings, PAPER_TRIPLETS) * base["step_s"]
            said[f"{stage}: hours of {profile.name} on {PAPER_TRIPLETS} triplets"] = seconds / 3600
        if loader:
            said[f"{stage}: triplets a second, loader / step"] = loader / base["triplets_per_s"]
    return said


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Measure both stages on a GPU, and say what the paper's run would take.")
    parser.add_argument("--profile", default="paper", help="whose sizes, encoder and steps (default: %(default)s)")
    parser.add_argument("--device", help="such as cuda:1, or cpu (default: a GPU, and an error without one)")
    parser.add_argument("--steps", type=int, default=100, help="of each trial (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=16, help="processes of the loader (default: %(default)s)")
    parser.add_argument("--budget", type=float, default=360, metavar="SECONDS", help="no trial begins later (default: %(default)s)")
    parser.add_argument("--out", default="results/bench_gpu", metavar="STEM", help="of the .json and .csv (default: %(default)s)")
    arguments = parser.parse_args(argv)
    device, profile = choose_device(arguments.device), load_profile(arguments.profile)
    if device.type != "cuda" and not arguments.device:
        raise InputError("there is no GPU here; --device cpu tries the script on the CPU, for hours at the paper's sizes")
    name = torch.cuda.get_device_name(device) if device.type == "cuda" else device.type
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory() as folder:
        bench = Bench(profile, device, arguments.steps, time.monotonic() + arguments.budget, folder)
        for row in bench.run(arguments.workers):
            rows.append(row)
            print(json.dumps(row), flush=True)
            said = verdicts(rows, profile)
            facts = {"device": name, "torch": torch.__version__, "profile": profile.name}
            write_json(f"{arguments.out}.json", facts | {"verdicts": said, "rows": rows})
            write_text(f"{arguments.out}.csv", pd.DataFrame(rows).assign(device=name).to_csv(index=False, float_format="%.4g"))
    for what, value in said.items():
        print(f"{what}: {value if isinstance(value, bool) else f'{value:.3g}'}")
    print(f"written to {arguments.out}.json and {arguments.out}.csv")
    return 0


if __name__ == "__main__":
    with exit_on_input_error():
        sys.exit(main())
