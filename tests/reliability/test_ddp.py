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
from tests.reliability.kills import finish

TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "dualdepth.cli"]


@pytest.fixture(scope="module")
def pair(tmp_path_factory):
    return Pair(tmp_path_factory.mktemp("pair"))


@pytest.fixture(scope="module")
def single(pair):
    return pair.one("lr")


@pytest.mark.slow
def test_two_processes_train_as_one_that_accumulates_the_same_halves(pair, single):
    double = pair.two("lr")
    assert largest_difference(weights_of(single[0]), weights_of(double[0])) <= 1e-6
    assert single[1].equals(double[1])  # the log: means over both halves, on both


@pytest.mark.slow
def test_told_to_stop_they_agree_on_a_step_and_one_process_goes_on_from_there(pair, single):
    resumed = pair.two_then_one("lr")
    assert largest_difference(weights_of(single[0]), weights_of(resumed[0])) <= 1e-6


@pytest.mark.slow
def test_when_one_process_dies_the_other_ends_within_a_minute(pair):
    run = pair.run(accumulate=1)
    both = start_two(run, "lr")
    wait_for_step(run, "lr", 2)
    os.kill(both[1].pid, signal.SIGKILL)
    began = time.monotonic()
    for process in both:
        process.join(60)
    assert [process.exitcode for process in both] == [1, -signal.SIGKILL]
    assert time.monotonic() - began < 60
    assert last_checkpoint(run.training("lr", 0))["step"] >= 2


@pytest.mark.slow
def test_torchrun_ends_with_the_error_of_the_process_that_met_it(pair):
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
    assert time.monotonic() - began < 60
    assert done.returncode != 0
    assert re.search(rf"^error: \S*{frame.name}: truncated", done.stderr, re.MULTILINE)
    assert not run.weights("lr", 0).exists()


@pytest.mark.slow
def test_weights_trained_by_hand_are_taken_by_the_chain(pair, capsys):
    """`torchrun … dualdepth train` first, the chain afterwards, which has one process and may cut batches otherwise."""
    from dualdepth.training.variants import train_variant

    run = pair.run(accumulate=1)
    for process in start_two(run, "lr"):
        finish(process)
    content = run.weights("lr", 0).read_bytes()
    train_variant(pair.run(accumulate=2), "lr", 0)
    assert "already trained" in capsys.readouterr().out and run.weights("lr", 0).read_bytes() == content
