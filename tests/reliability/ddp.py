"""Two processes (gloo, on the CPU) against one that accumulates the same half-batches, and what happens when one of them stops.

python -m tests.reliability.ddp
"""

import json
import os
import signal
import socket
import sys
import tempfile
import time
from multiprocessing.process import BaseProcess
from pathlib import Path

import pandas as pd
import torch
from safetensors.torch import load

from dualdepth.run import Run
from dualdepth.training.checkpoints import checkpoint_paths
from tests.reliability.counting import write_count
from tests.reliability.kills import finish, make_checkout, outcome, start


def start_two(run: Run, variant: str) -> list[BaseProcess]:
    """Start a training on two processes, as torchrun would."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    return [start(run, variant, 0, RANK=rank, LOCAL_RANK=rank, **shared) for rank in ("0", "1")]


def wait_for_step(run: Run, variant: str, step: int, seconds: float = 120) -> None:
    """Wait until a checkpoint of that step or a later one is there."""
    until = time.monotonic() + seconds
    while not any(int(path.stem[-8:]) >= step for path in checkpoint_paths(run.training(variant, 0))):
        if time.monotonic() > until:
            raise TimeoutError(f"no checkpoint of step {step} within {seconds} s")
        time.sleep(0.002)


def weights_of(content: bytes) -> dict[str, torch.Tensor]:
    """Tensors of released weights, without the statistics of batch norm: each process counts its own."""
    return {
        name: tensor for name, tensor in load(content).items() if not name.endswith(("running_mean", "running_var", "num_batches_tracked"))
    }


def largest_difference(a: dict[str, torch.Tensor], b: dict[str, torch.Tensor]) -> float:
    """Over all weights."""
    assert a.keys() == b.keys()
    return max((value.double() - b[name].double()).abs().max().item() for name, value in a.items())


class Pair:
    """A checkout in which one process or two train the same; `profile` decides into how many parts one process cuts a batch."""

    def __init__(self, root: Path) -> None:
        make_checkout(root, beyond_paper_corridor_steps=2, beyond_paper_mirrored_motion=True)
        self.root, self.profile = root, root / "own.yaml"
        self.kept = 0

    def run(self, accumulate: int) -> Run:
        """The run, whose profile cuts batches so."""
        values = json.loads(self.profile.read_text())
        values["training"]["accumulate"] = accumulate
        self.profile.write_text(json.dumps(values))
        return Run(str(self.profile), self.root)

    def take(self, run: Run, variant: str) -> tuple[bytes, pd.DataFrame]:
        """The outcome of a finished training, whose folder is moved out of the way."""
        found = outcome(run, variant, 0)
        self.kept += 1
        run.training(variant, 0).rename(self.root / f"kept{self.kept}")
        return found

    def one(self, variant: str) -> tuple[bytes, pd.DataFrame]:
        """Train on one process that accumulates."""
        run = self.run(accumulate=2)
        finish(start(run, variant, 0))
        return self.take(run, variant)

    def two(self, variant: str) -> tuple[bytes, pd.DataFrame]:
        """Train on two processes."""
        run = self.run(accumulate=1)
        for process in start_two(run, variant):
            finish(process)
        return self.take(run, variant)

    def two_then_one(self, variant: str) -> tuple[bytes, pd.DataFrame]:
        """Train on two processes, tell one of them to stop, and go on with one process."""
        run = self.run(accumulate=1)
        both = start_two(run, variant)
        wait_for_step(run, variant, 3)
        os.kill(both[1].pid, signal.SIGTERM)  # only the one that does not write
        for process in both:
            process.join(60)
        if run.weights(variant, 0).exists():
            raise RuntimeError("they were not stopped")
        run = self.run(accumulate=2)
        finish(start(run, variant, 0))
        return self.take(run, variant)


def main() -> int:
    """Compare both stages, and twice the same."""
    held, differences = 0, []
    with tempfile.TemporaryDirectory() as root:
        pair = Pair(Path(root))
        for variant in ("lr", "dual"):
            single, double, again, resumed = pair.one(variant), pair.two(variant), pair.two(variant), pair.two_then_one(variant)
            differences.append(largest_difference(weights_of(single[0]), weights_of(double[0])))
            differences.append(largest_difference(weights_of(single[0]), weights_of(resumed[0])))
            held += differences[-2] <= 1e-6 and single[1].equals(double[1])
            held += double[0] == again[0] and double[1].equals(again[1])
            held += differences[-1] <= 1e-6
            if variant == "lr":  # stage 2 starts from it
                folder = pair.run(accumulate=2).training("lr", 0)
                folder.parent.mkdir(exist_ok=True)
                (pair.root / "kept1").rename(folder)
    note = f"largest difference of a weight {max(differences):.1g}; the same again to the bit; two processes stopped, one went on"
    write_count("two processes (gloo) against one that accumulates", 6, held, note)
    print(f"{held} of 6 held: {note}")
    return 0 if held == 6 else 1


if __name__ == "__main__":
    sys.exit(main())
