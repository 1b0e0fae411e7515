"""Trainings killed at random moments and started again, against the training that was never killed.

    python -m tests.reliability.kills --kills 50

Each trial is a process of its own, killed with all its loader workers by SIGKILL: at a random moment, or while a checkpoint is being
written. Trials are forked from a server that has imported everything, so a start costs little, and has computed nothing: OpenMP hangs in
the child of a process that has.
"""

import contextlib
import multiprocessing
import os
import random
import shutil
import signal
import sys
import time
from collections.abc import Callable
from multiprocessing.process import BaseProcess
from pathlib import Path

import pandas as pd
import psutil
import torch

from dualdepth.device import keep_freed_memory
from dualdepth.run import Run
from dualdepth.training.checkpoints import checkpoint_paths
from dualdepth.training.variants import train_variant
from tests.reliability.counting import Tally, count_kills, until_killed
from tests.small_checkout import checkout_of, prepare
from tests.small_encoder import save_encoder
from tests.small_kitti import write_calibration, write_drive

FRAMES, VARIANTS = 10, ("lr", "dual")
IMPORTED = [
    *("dualdepth.training.variants", "matplotlib.figure", "accelerate", "kornia", "torch._inductor", "torch.utils.tensorboard"),
    *("transformers.models.resnet.modeling_resnet", "huggingface_hub.serialization"),
]
"""What a training imports, also when it is under way."""


def make_checkout(root: Path, **training: object) -> Run:
    """A folder that looks like a checkout, with prepared frames and a profile of two small trainings."""
    stage = {"batch_size": 2, "epochs": 2}
    # loader workers, two half-batches a step, a checkpoint after each step
    usual = {"workers": 1, "accumulate": 2, "checkpoint_every": 1, "lr": stage, "hr": stage}
    run = checkout_of(root, save_encoder(root / "encoder"), usual | training, train={"lr": None, "dual": None})
    write_calibration(root / "kitti")
    write_drive(root / "kitti", range(FRAMES))
    prepare(run)
    return run


def wait_until(true: Callable[[], object], seconds: float = 120) -> None:
    """Wait for something; a `TimeoutError` if it takes too long."""
    until = time.monotonic() + seconds
    while not true():
        if time.monotonic() > until:
            raise TimeoutError(f"still waiting after {seconds} s")
        time.sleep(0.005)


def start(run: Run, variant: str, **environment: str) -> BaseProcess:
    """Train seed 0 in a process of its own group, with more in its environment."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(IMPORTED)
    process = server.Process(target=_train, args=(run, variant, environment))
    process.start()
    while process.is_alive() and os.getpgid(process.pid) != process.pid:
        time.sleep(0.0005)
    return process


def _train(run: Run, variant: str, environment: dict[str, str]) -> None:
    os.setsid()
    os.environ.update(environment)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    multiprocessing.set_start_method("fork", force=True)  # of loader processes, as in any training; a server's children have a server's
    torch.set_num_threads(1)  # as each of several processes has; how a sum is split decides its last digits
    train_variant(run, variant, 0)


def finish(process: BaseProcess) -> None:
    """Wait for a training; a `RuntimeError` if it fails or takes too long."""
    process.join(300)
    if process.exitcode is None:
        os.killpg(process.pid, signal.SIGKILL)
    if process.exitcode != 0:
        raise RuntimeError(f"the training ended with {process.exitcode} within 300 s")


def outcome(run: Run, variant: str) -> tuple[bytes, pd.DataFrame]:
    """Weights and log of a finished training."""
    return run.weights(variant, 0).read_bytes(), pd.read_csv(run.training(variant, 0) / "log.csv").drop(columns="steps_per_second")


def newest_step(folder: Path) -> int:
    """Of a training's checkpoints."""
    return max((int(path.stem[-8:]) for path in checkpoint_paths(folder)), default=0)


def caught_writing(process: BaseProcess, folder: Path) -> bool:
    """Whether a training is in the middle of writing a file; if so, it is held there, to be killed."""
    if not any(folder.glob(".*.part*")):
        return False
    with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):  # it may have ended by now
        os.killpg(process.pid, signal.SIGSTOP)
        trained = psutil.Process(process.pid)
        while trained.status() not in (psutil.STATUS_STOPPED, psutil.STATUS_ZOMBIE):
            time.sleep(0.0005)
        if any(folder.glob(".*.part*")):
            return True
        os.killpg(process.pid, signal.SIGCONT)  # the file was renamed meanwhile
    return False


def kill_at_random(run: Run, variant: str, kills: int, seconds: float, rng: random.Random) -> tuple[int, int]:
    """Start a training, kill it, start it again … and at last let it end; `seconds` are those of two of its steps. Gives the kills, and how
    many of them left a half-written file."""
    folder, done, torn = run.training(variant, 0), 0, 0
    while done < kills:
        process = start(run, variant)
        # moments are spread over steps, since the time that a start takes is a busy machine's
        step, aim, moment = newest_step(folder) + rng.randrange(3), rng.random() < 0.5, None
        while process.is_alive():
            now = time.monotonic()
            if moment is None and newest_step(folder) >= step:
                moment = now + rng.uniform(0, seconds)
            if moment is not None and now > moment and (not aim or caught_writing(process, folder)):
                break
            time.sleep(0.0005)
        else:
            return done, torn
        os.killpg(process.pid, signal.SIGKILL)
        process.join()
        done, torn = done + 1, torn + any(folder.glob(".*.part*"))
    finish(start(run, variant))
    return done, torn


def try_kills(root: Path, kills: int, each: int, seed: int = 0, **training: object) -> list[Tally]:
    """Train both stages unkilled, then again and again with up to `each` kills, until there were `kills`.

    Stage 2 starts from the stage 1 that was never killed; `training` are changes of both, as `make_checkout` takes them.
    """
    keep_freed_memory()
    run, rng, expected, seconds = make_checkout(root, **training), random.Random(seed), {}, {}
    for variant in VARIANTS:
        began = time.monotonic()
        finish(start(run, variant))
        expected[variant] = outcome(run, variant)
        seconds[variant] = 2 * (time.monotonic() - began) / len(expected[variant][1])

    def kill_one(number: int, kills: int) -> Tally:
        variant = VARIANTS[number % 2]
        folder, kept = run.training(variant, 0), root / "kept"
        folder.rename(kept)
        done, torn = kill_at_random(run, variant, kills, seconds[variant], rng)
        weights, log = outcome(run, variant)
        wrong = [f"left: {path}" for path in folder.rglob(".*.part*")]
        wrong += ["weights differ"] * (weights != expected[variant][0]) + ["the log differs"] * (not log.equals(expected[variant][1]))
        shutil.rmtree(folder)
        kept.rename(folder)
        return Tally(done, torn, wrong)

    return until_killed(kills, each, kill_one)


if __name__ == "__main__":
    note = "trainings of both stages, {} kills in the middle of writing a file; weights to the bit, log but for its speed"
    sys.exit(count_kills(try_kills, note, kills=50, each=4))
