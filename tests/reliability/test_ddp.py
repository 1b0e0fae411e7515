"""Several processes train as one, and end together."""

import os
import re
import signal
import subprocess
import sys
import time

import pytest

from dualdepth.training.checkpoints import last_checkpoint
from tests.reliability.ddp import Pair, largest_difference, start_two, wait_for_step, weights_of

pytestmark = pytest.mark.slow
TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "dualdepth.cli"]


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return Pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="module")
def single(pair):
    return pair.one("lr")


def test_two_processes_train_as_one_that_accumulates_the_same_halves(pair, single, counted):
    with counted():
        double = pair.two("lr")
        assert largest_difference(weights_of(single[0]), weights_of(double[0])) <= 1e-6
        assert single[1].equals(double[1])  # the log: means over both halves, on both


def test_told_to_stop_they_agree_on_a_step_and_one_process_goes_on_from_there(pair, single, counted):
    with counted():
        resumed = pair.two_then_one("lr")
        assert largest_difference(weights_of(single[0]), weights_of(resumed[0])) <= 1e-6


def test_when_one_process_dies_the_other_ends_within_a_minute(pair, counted):
    run = pair.run(accumulate=1)
    both = start_two(run, "lr")
    wait_for_step(run, "lr", 2)
    os.kill(both[1].pid, signal.SIGKILL)
    began = time.monotonic()
    for process in both:
        process.join(60)
    with counted():
        assert [process.exitcode for process in both] == [1, -signal.SIGKILL]
        assert time.monotonic() - began < 60
        assert last_checkpoint(run.training("lr", 0))["step"] >= 2


def test_torchrun_ends_with_the_error_of_the_process_that_met_it(pair, counted):
    run = pair.run(accumulate=1)
    frame = sorted((pair.root / "kitti").rglob("*.png"))[3]
    content = frame.read_bytes()
    frame.write_bytes(content[:100])
    began = time.monotonic()
    try:
        done = subprocess.run(
            [sys.executable, *TORCHRUN, "train", "--profile", str(pair.profile), "--variant", "lr"],
            cwd=pair.root,
            capture_output=True,
            text=True,
            timeout=120,
            env=os.environ | {"OMP_NUM_THREADS": "1"},
        )
    finally:
        frame.write_bytes(content)
    with counted():
        assert time.monotonic() - began < 60 and done.returncode != 0
        assert re.search(rf"^error: \S*{frame.name}: truncated", done.stderr, re.MULTILINE)
        assert not run.weights("lr", 0).exists()
