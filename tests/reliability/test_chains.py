"""The chain or a training is killed, stopped or begun twice; the next run ends as if nothing had been. The soak does this for longer."""

import os
import re
import signal
import subprocess
import sys

import psutil
import pytest

from dualdepth.run import project_root
from dualdepth.training.checkpoints import checkpoint_paths, last_checkpoint
from tests.reliability import kills
from tests.reliability.chains import Chain, is_held, try_kills
from tests.small_chain import SmallChain

pytestmark = pytest.mark.slow

LAST = "the last line\n"
SLOWLY = f"""
    with atomic_path(path) as partial:
        partial.write_text(said)
        time.sleep(0.05)
        while pathlib.Path("wait").exists():
            time.sleep(0.05)
        partial.write_text(said + "\\n{LAST[:-1]}\\n")
"""


class StandIns(Chain):
    """A chain whose notebooks are stand-ins that write their files slowly."""

    def outcome(self):
        """All that the chain leaves, but for its bookkeeping."""
        files = [path for folder in ("work", "results") for path in (self.root / folder).rglob("*") if path.is_file()]
        return {str(path.relative_to(self.root)): path.read_bytes() for path in files if path.name not in ("lock", "profile.txt")}

    def broken(self):
        """Files under their final names that do not end as they should."""
        return [name for name, content in self.outcome().items() if ".part" not in name and not content.endswith(LAST.encode())]


@pytest.fixture
def chain(tmp_path):
    small = StandIns(SmallChain.make(tmp_path).root)
    command = tmp_path / "bin/dualdepth"
    code = command.read_text()
    assert "path.write_text(said)" in code
    code = code.replace("import pathlib, re, sys", "import pathlib, re, sys, time\nfrom dualdepth.files import atomic_path")
    command.write_text(code.replace("path.write_text(said)", SLOWLY.strip()))
    return small


def test_a_chain_killed_at_random_ends_with_the_same_files(chain, counted):
    with counted():
        tallies = try_kills(chain, kills=2, each=2)
        assert sum(tally.kills for tally in tallies) == 2
        assert not any(tally.wrong for tally in tallies) and len(chain.outcome()) > 20
    assert not [*chain.root.glob("results/**/*.part*"), *chain.root.glob("work/*/*.part*"), *chain.root.glob("work/*/prepared/*.part*")]


def test_a_live_run_stops_a_second_one_and_says_whose_it_is_until_it_is_killed(chain, counted):
    (chain.root / "wait").touch()  # which keeps it at work on its first notebook
    running = chain.start()
    kills.wait_until(lambda: running.poll() is not None or any((chain.root / "results").glob("*/notebooks/.*.part*")))
    assert running.poll() is None, chain.said()
    assert "snakemake" in psutil.Process(running.pid).cmdline()  # which the command has become
    with counted():
        done = chain.reproduce()
        assert done.returncode == 2 and len(done.stderr.splitlines()) == 1 and f"held by process {running.pid} on " in done.stderr
    with counted():
        os.killpg(running.pid, signal.SIGKILL)
        running.wait()
        assert not is_held(chain.root / "work/own/lock")


def test_killed_trainings_of_both_stages_end_with_the_same_weights(tmp_path):
    six = {"batch_size": 2, "epochs": 2, "max_steps": 6}
    tallies = kills.try_kills(tmp_path, kills=3, each=2, seed=6, lr=six, hr=six)  # draws both kinds of moments
    assert not any(tally.wrong for tally in tallies)
    assert len(tallies) >= 2  # both stages
    assert sum(tally.special for tally in tallies) > 0


@pytest.mark.parametrize(
    "send",
    [pytest.param(os.killpg, id="its group with loader workers"), pytest.param(os.kill, marks=pytest.mark.soak, id="its own process")],
)
def test_sigterm_ends_a_training_with_a_checkpoint_and_one_line(send, tmp_path, counted):
    run = kills.make_checkout(tmp_path, lr={"batch_size": 2, "epochs": 200})
    words = ["-m", "dualdepth.cli", "train", "--profile", "own.yaml", "--variant", "lr"]
    environment = os.environ | {"PYTHONPATH": str(project_root()), "OMP_NUM_THREADS": "1"}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True, "start_new_session": True}
    process = subprocess.Popen([sys.executable, *words], cwd=tmp_path, env=environment, **pipes)
    try:
        kills.wait_until(lambda: checkpoint_paths(run.training("lr", 0)) or process.poll() is not None)
        send(process.pid, signal.SIGTERM)
        said = process.communicate(timeout=120)[0]
    finally:
        process.kill()
    with counted():
        last = said.replace("\r", "\n").strip().splitlines()[-1]
        stopped = re.fullmatch(r"stopped at step (\d+) of \d+; run the same command to go on", last)
        assert process.returncode == 1 and stopped, said[-3000:]
        assert said.count("stopped at step") == 1 and "Traceback" not in said
        assert last_checkpoint(run.training("lr", 0))["step"] == int(stopped[1])
        assert not run.weights("lr", 0).exists()
