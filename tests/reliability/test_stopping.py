"""SIGTERM, to one process or to all of its group, ends a training with a checkpoint and one line."""

import os
import re
import shutil
import signal
import subprocess
import sys
import time

import pytest

from dualdepth.run import Run, project_root
from dualdepth.training.checkpoints import checkpoint_paths, last_checkpoint
from tests.reliability.kills import make_checkout


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A checkout with prepared frames, a profile of long trainings, and the training's notebook."""
    root = tmp_path_factory.mktemp("checkout")
    make_checkout(root, lr={"batch_size": 2, "epochs": 200})
    shutil.copyfile(project_root() / "notebooks/03_train_lr.ipynb", root / "notebooks/03_train_lr.ipynb")
    return Run(str(root / "own.yaml"), root)


def started(run, *command):
    """The command as a process group of its own."""
    return subprocess.Popen(
        [sys.executable, "-m", "dualdepth.cli", *command],
        cwd=run.root,
        env=os.environ | {"PYTHONPATH": str(project_root()), "OMP_NUM_THREADS": "1"},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )


def wait_until(true, seconds=120):
    until = time.monotonic() + seconds
    while not true():
        assert time.monotonic() < until
        time.sleep(0.01)


BY_NOTEBOOK = ["notebook", "03_train_lr", "--out", "{seed}.ipynb", "--set", "profile=own.yaml", "variant=lr", "seed={seed}"]
BY_HAND = ["train", "--profile", "own.yaml", "--variant", "lr", "--seed", "{seed}"]


@pytest.mark.parametrize(
    "seed, command, send",
    [
        pytest.param(0, BY_NOTEBOOK, os.killpg, marks=pytest.mark.slow, id="notebook, its group"),
        pytest.param(1, BY_HAND, os.killpg, marks=pytest.mark.slow, id="by hand, its group with loader workers"),
        pytest.param(2, BY_NOTEBOOK, os.kill, marks=pytest.mark.soak, id="notebook, its own process"),
        pytest.param(3, BY_HAND, os.kill, marks=pytest.mark.soak, id="by hand, its own process"),
    ],
)
def test_sigterm_ends_a_training_with_a_checkpoint_and_one_line(checkout, seed, command, send, counted):
    run = checkout
    process = started(run, *(word.format(seed=seed) for word in command))
    try:
        wait_until(lambda: checkpoint_paths(run.training("lr", seed)) or process.poll() is not None)
        send(process.pid, signal.SIGTERM)
        said = process.communicate(timeout=120)[0]
    finally:
        process.kill()
    with counted():
        last = said.replace("\r", "\n").strip().splitlines()[-1]
        stopped = re.fullmatch(r"stopped at step (\d+) of \d+; run the same command to go on", last)
        assert process.returncode == 1 and stopped, said[-3000:]
        assert said.count("stopped at step") == 1 and "Traceback" not in said
        assert last_checkpoint(run.training("lr", seed))["step"] == int(stopped[1])
        assert not run.weights("lr", seed).exists() and not (run.root / f"{seed}.ipynb").exists()
