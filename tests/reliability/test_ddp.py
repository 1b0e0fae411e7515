"""Two processes (gloo, on the CPU) train as one that accumulates the same half-batches, and end together."""

import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time

import pytest
from safetensors.torch import load

from dualdepth.training.checkpoints import last_checkpoint
from tests.reliability.kills import finish, make_checkout, newest_step, outcome, start, wait_until

pytestmark = pytest.mark.slow
TORCHRUN = ["-m", "torch.distributed.run", "--standalone", "--nproc-per-node", "2", "-m", "dualdepth.cli"]


def checkout(root, processes):
    """A checkout in which so many processes cut a batch into two parts."""
    return make_checkout(root, accumulate=2 // processes, beyond_paper_corridor_steps=2)


def start_two(run, variant):
    """Start a training on two processes, as torchrun would."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    shared = {"WORLD_SIZE": "2", "LOCAL_WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": port}
    return [start(run, variant, RANK=rank, LOCAL_RANK=rank, **shared) for rank in ("0", "1")]


def largest_difference(a, b):
    """Over all weights in two files' bytes, without the statistics of batch norm: each process counts its own."""
    a, b = (
        {k: v.double() for k, v in load(content).items() if not k.endswith(("running_mean", "running_var", "num_batches_tracked"))}
        for content in (a, b)
    )
    assert a.keys() == b.keys()
    return max((value - b[name]).abs().max().item() for name, value in a.items())


@pytest.fixture(scope="module", params=["lr", pytest.param("dual", marks=pytest.mark.soak)])
def variant(request):
    return request.param


@pytest.fixture(scope="module")
def root(variant, tmp_path_factory):
    """Where the variant is trained; of stage 2, with the weights that it starts from."""
    root = tmp_path_factory.mktemp("root")
    if variant == "dual":
        finish(start(checkout(root, 1), "lr"))
    return root


@pytest.fixture(scope="module")
def train(root, variant):
    """Trains it to the end on one process or two; gives weights and log, and leaves nothing."""

    def call(processes):
        run = checkout(root, processes)
        for process in start_two(run, variant) if processes == 2 else [start(run, variant)]:
            finish(process)
        found = outcome(run, variant)
        shutil.rmtree(run.training(variant, 0))
        return found

    return call


@pytest.fixture(scope="module")
def single(train):
    return train(1)


def test_two_processes_train_as_one_that_accumulates_the_same_halves(train, single, counted):
    with counted():
        double = train(2)
        assert largest_difference(single[0], double[0]) <= 1e-6
        assert single[1].equals(double[1])  # the log: means over both halves, on both


@pytest.mark.soak
def test_two_processes_do_the_same_again_to_the_bit(train, counted):
    with counted():
        double, again = train(2), train(2)
        assert double[0] == again[0] and double[1].equals(again[1])


def test_told_to_stop_they_agree_on_a_step_and_one_process_goes_on_from_there(root, variant, train, single, counted):
    run = checkout(root, 2)
    both = start_two(run, variant)
    wait_until(lambda: newest_step(run.training(variant, 0)) >= 3)
    os.kill(both[1].pid, signal.SIGTERM)  # only the one that does not write
    for process in both:
        process.join(60)
    with counted():
        assert newest_step(run.training(variant, 0)) and not run.weights(variant, 0).exists()
        assert largest_difference(single[0], train(1)[0]) <= 1e-6


def test_when_one_process_dies_the_other_ends_within_a_minute(tmp_path, counted):
    run = checkout(tmp_path, 2)
    both = start_two(run, "lr")
    wait_until(lambda: newest_step(run.training("lr", 0)) >= 2)
    os.kill(both[1].pid, signal.SIGKILL)
    began = time.monotonic()
    for process in both:
        process.join(60)
    with counted():
        assert [process.exitcode for process in both] == [1, -signal.SIGKILL]
        assert time.monotonic() - began < 60
        assert last_checkpoint(run.training("lr", 0))["step"] >= 2


def test_torchrun_ends_with_the_error_of_the_process_that_met_it(tmp_path, counted):
    run = checkout(tmp_path, 2)
    frame = sorted((tmp_path / "kitti").rglob("*.png"))[3]
    frame.write_bytes(frame.read_bytes()[:100])
    began = time.monotonic()
    words = [sys.executable, *TORCHRUN, "train", "--profile", "own.yaml", "--variant", "lr"]
    environment = os.environ | {"OMP_NUM_THREADS": "1"}
    done = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=120, env=environment)
    with counted():
        assert time.monotonic() - began < 60 and done.returncode != 0
        assert re.search(rf"^error: \S*{frame.name}: truncated", done.stderr, re.MULTILINE)
        assert not run.weights("lr", 0).exists()
