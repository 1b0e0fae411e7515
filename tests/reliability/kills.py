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
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import NamedTuple

import pandas as pd
import psutil
import torch

from dualdepth.device import keep_freed_memory
from dualdepth.run import Run
from dualdepth.training.checkpoints import checkpoint_paths
from dualdepth.training.log import read_log
from dualdepth.training.variants import train_variant
from tests.reliability.counting import count_kills
from tests.small_checkout import checkout_of, prepare
from tests.small_encoder import save_encoder
from tests.small_kitti import write_calibration, write_drive

FRAMES = 10
IMPORTED = [
    *("dualdepth.training.variants", "matplotlib.figure", "accelerate", "kornia", "torch._inductor", "torch.utils.tensorboard"),
    *("transformers.models.resnet.modeling_resnet", "huggingface_hub.serialization"),
]
"""What a training imports, also when it is under way."""


class Tally(NamedTuple):
    """What became of the trials of one training."""

    kills: int
    while_writing: int
    """Kills that left a half-written file behind."""
    identical: bool
    """Weights to the bit, and the log but for its speed."""


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


def start(run: Run, variant: str, seed: int, **environment: str) -> BaseProcess:
    """Train in a process of its own group, with more in its environment."""
    server = multiprocessing.get_context("forkserver")
    server.set_forkserver_preload(IMPORTED)
    process = server.Process(target=_train, args=(run, variant, seed, environment))
    process.start()
    while process.is_alive() and os.getpgid(process.pid) != process.pid:
        time.sleep(0.0005)
    return process


def _train(run: Run, variant: str, seed: int, environment: dict[str, str]) -> None:
    os.setsid()
    os.environ.update(environment)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 1)
        os.dup2(nowhere.fileno(), 2)
    multiprocessing.set_start_method("fork", force=True)  # of loader processes, as in any training; a server's children have a server's
    torch.set_num_threads(1)  # as each of several processes has; how a sum is split decides its last digits
    train_variant(run, variant, seed)


def finish(process: BaseProcess, seconds: float = 300) -> None:
    """Wait for a process.

    Raises:
        RuntimeError: it failed, or takes too long.
    """
    process.join(seconds)
    if process.exitcode is None:
        os.killpg(process.pid, signal.SIGKILL)
        raise RuntimeError(f"the training did not end within {seconds} s")
    if process.exitcode:
        raise RuntimeError(f"the training ended with {process.exitcode}")


def outcome(run: Run, variant: str, seed: int) -> tuple[bytes, pd.DataFrame]:
    """Weights and log of a finished training."""
    folder = run.training(variant, seed)
    return run.weights(variant, seed).read_bytes(), read_log(folder / "log.csv").drop(columns="steps_per_second")


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


def kill_at_random(run: Run, variant: str, seed: int, kills: int, seconds: float, rng: random.Random) -> tuple[int, int]:
    """Start a training, kill it, start it again … and at last let it end; `seconds` are those of two of its steps.

    Returns:
        Kills, and how many of them left a half-written file.
    """
    folder, done, torn = run.training(variant, seed), 0, 0
    while done < kills:
        process = start(run, variant, seed)
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
    finish(start(run, variant, seed))
    return done, torn


def try_kills(root: Path, kills: int, each: int, seed: int = 0, **training: object) -> list[Tally]:
    """Train both stages unkilled, then again and again with up to `each` kills, until there were `kills`.

    Stage 2 starts from the stage 1 that was never killed; `training` are changes of both, as `make_checkout` takes them.
    """
    keep_freed_memory()
    run, rng = make_checkout(root, **training), random.Random(seed)
    expected, seconds, tallies = {}, {}, []
    for variant in ("lr", "dual"):
        began = time.monotonic()
        finish(start(run, variant, 0))
        expected[variant] = outcome(run, variant, 0)
        seconds[variant] = 2 * (time.monotonic() - began) / len(expected[variant][1])
    while sum(tally.kills for tally in tallies) < kills:
        variant = ("lr", "dual")[len(tallies) % 2]
        folder, kept = run.training(variant, 0), root / "kept"
        folder.rename(kept)
        left = kills - sum(tally.kills for tally in tallies)
        done, torn = kill_at_random(run, variant, 0, min(each, left), seconds[variant], rng)
        weights, log = outcome(run, variant, 0)
        same = weights == expected[variant][0] and log.equals(expected[variant][1])
        leftovers = [path for path in folder.rglob(".*.part*")]
        tallies.append(Tally(done, torn, same and not leftovers))
        said = "the same" if tallies[-1].identical else "DIFFERENT"
        print(f"  {sum(tally.kills for tally in tallies)} of {kills} kills, {said}", flush=True)
        shutil.rmtree(folder)
        kept.rename(folder)
    return tallies


def counted(root: Path, kills: int, each: int) -> tuple[list[int], int, str]:
    """As `count_kills` takes it."""
    tallies = try_kills(root, kills, each)
    torn, held = sum(t.while_writing for t in tallies), sum(t.kills for t in tallies if t.identical)
    note = f"trainings of both stages, {torn} kills in the middle of writing a file; weights to the bit, log but for its speed"
    return [t.kills for t in tallies], held, note


if __name__ == "__main__":
    sys.exit(count_kills("training killed by SIGKILL and started again", 50, 4, counted))
