"""SIGTERM, to one process or to all of its group, ends a training with a checkpoint and one line."""

import os
import re
import signal
import subprocess
import sys

import pytest

from dualdepth.run import project_root
from dualdepth.training.checkpoints import checkpoint_paths, last_checkpoint
from tests.reliability.kills import make_checkout, wait_until


@pytest.fixture(scope="module")
def checkout(tmp_path_factory):
    """A checkout with prepared frames and a profile of long trainings."""
    return make_checkout(tmp_path_factory.mktemp("checkout"), lr={"batch_size": 2, "epochs": 200})


@pytest.mark.parametrize(
    "seed, send",
    [
        pytest.param(0, os.killpg, marks=pytest.mark.slow, id="its group with loader workers"),
        pytest.param(1, os.kill, marks=pytest.mark.soak, id="its own process"),
    ],
)
def test_sigterm_ends_a_training_with_a_checkpoint_and_one_line(checkout, seed, send, counted):
    run, words = checkout, ["train", "--profile", "own.yaml", "--variant", "lr", "--seed", str(seed)]
    environment = os.environ | {"PYTHONPATH": str(project_root()), "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    process = subprocess.Popen([sys.executable, "-m", "dualdepth.cli", *words], cwd=run.root, env=environment, **pipes)
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
        assert not run.weights("lr", seed).exists()
