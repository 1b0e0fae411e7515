"""`dualdepth reproduce` killed at random moments and started again, against the chain that was never killed.

    python -m tests.reliability.chains --kills 20

A chain is a process group of its own. A kill is SIGKILL to all that it started, as when a machine loses power, or to its group alone,
which leaves the kernels of its notebooks behind.
"""

import contextlib
import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import psutil

from dualdepth.errors import InputError
from dualdepth.files import locked
from dualdepth.run import project_root
from dualdepth.training.checkpoints import load_checkpoint
from dualdepth.training.weights import finished_card
from tests.reliability.counting import Tally, count_kills, until_killed
from tests.small_chain import SmallChain
from tests.small_encoder import save_encoder

PROFILE = {
    "about": "a chain to be killed",
    "world": {
        **{"size": [200, 640], "train_drives": 1, "frames_per_drive": 10, "static_frames": 3, "laser_train_frames": 2, "test_drives": 1},
        **{"test_frames": 2, "odometry_train": 1, "odometry_test": 0, "odometry_frames": 4, "make3d_images": 1},
    },
    "data": {"source": "miniature", "hr_size": [192, 288]},
    "training": {
        **{"pretrained": False, "workers": 1, "checkpoint_every": 1, "log_every": 1, "panel_every": 4},
        **{"lr": {"batch_size": 2, "max_steps": 6, "epochs": 4}, "hr": {"batch_size": 2, "max_steps": 3, "epochs": 4}},
    },
    "train": {"lr": None, "dual": None},
}
TIMED = ("latency_ms", "peak_mb")
"""How columns and rows begin or are called that no two runs share."""


READERS: dict[str, Callable[[Path], object]] = {
    ".json": lambda path: json.loads(path.read_bytes()),
    ".ipynb": lambda path: json.loads(path.read_bytes())["cells"],
    ".csv": lambda path: path.read_bytes() == b"\n" or (path.read_bytes().endswith(b"\n") and pd.read_csv(path).columns[0]),  # or empty
    ".npz": lambda path: [*np.load(path).values()],
    ".pt": load_checkpoint,
    ".html": lambda path: path.read_bytes().rstrip().endswith(b"</html>"),
    ".safetensors": lambda path: finished_card(path) or not path.with_name("trained.json").exists(),
}
"""How to read each kind of file that a chain writes; an error or a false value means that it is not whole."""


class Chain(SmallChain):
    """The real chain of a small profile: all notebooks, both stages of a small network."""

    @classmethod
    def make(cls, root: Path) -> "Chain":
        for name in ("Snakefile", "environment.lock"):
            shutil.copyfile(project_root() / name, root / name)
        for name in ("notebooks", "docs"):
            shutil.copytree(project_root() / name, root / name)
        (root / "bin").symlink_to(Path(sys.executable).parent)  # what the notebooks' shells find as `dualdepth`
        training = PROFILE["training"] | {"encoder": save_encoder(root / "encoder")}
        (root / "own.yaml").write_text(json.dumps(PROFILE | {"training": training}))  # JSON is YAML
        return cls(root)

    def start(self) -> subprocess.Popen[bytes]:
        """Start it; what it says goes to `said.txt`."""
        command = [sys.executable, "-m", "dualdepth.cli", "reproduce", "--profile", str(self.profile)]
        with open(self.root / "said.txt", "wb") as said:
            return subprocess.Popen(command, cwd=self.root, env=self.environment, stdout=said, stderr=said, start_new_session=True)

    def said(self) -> str:
        """The end of what the last run said."""
        return (self.root / "said.txt").read_text(errors="replace")[-2000:]

    def outcome(self) -> dict[str, bytes]:
        """What a finished chain leaves, by name: tables without what is timed, prepared files, weights."""
        found = {}
        for pattern in ("work/*/prepared/*", "work/*/runs/*/*/*.safetensors"):
            found |= {str(path.relative_to(self.root)): path.read_bytes() for path in self.root.glob(pattern) if path.is_file()}
        for path in self.root.glob("results/*/tables/*.csv"):
            if path.name == "backbone.csv":
                table = pd.read_csv(path)
                found[path.name] = table[[name for name in table if not name.startswith(TIMED)]].to_csv(index=False).encode()
            else:
                lines = path.read_bytes().splitlines(keepends=True)
                found[path.name] = b"".join(line for line in lines if not any(name.encode() in line for name in TIMED))
        found["pages"] = "\n".join(sorted(p.name for p in self.root.glob("results/*/notebooks/*"))).encode()
        return found

    def broken(self) -> list[str]:
        """Files under their final names that are not whole."""
        found = []
        for path in sorted([*self.root.glob("work/*/**/*"), *self.root.glob("results/*/**/*")]):
            read = READERS.get(path.suffix)
            if read is None or not path.is_file() or ".part" in path.name or ".failed" in path.name:
                continue
            try:
                whole = read(path)
            except FileNotFoundError:  # an orphan's checkpoint, replaced by its next
                continue
            except Exception as error:  # each reader has errors of its own
                whole, path = False, f"{path} ({error})"
            if whole is False or whole == "":
                found.append(f"half-written: {path}")
        return found


def is_held(lock: Path) -> bool:
    """Whether a live process holds a lock file."""
    try:
        with locked(lock):
            return False
    except InputError:
        return True


def kill(chain: subprocess.Popen[bytes], everything: bool) -> None:
    """SIGKILL to a chain's group, or to everything below it, and wait until it is gone."""
    below = psutil.Process(chain.pid).children(recursive=True)
    group = [process for process in below if everything or _group(process) == chain.pid]
    os.killpg(chain.pid, signal.SIGKILL)
    for process in group:
        with contextlib.suppress(psutil.NoSuchProcess):
            process.kill()
    chain.wait()
    psutil.wait_procs(group, timeout=30)


def _group(process: psutil.Process) -> int | None:
    with contextlib.suppress(ProcessLookupError):
        return os.getpgid(process.pid)
    return None


def kill_at_random(chain: Chain, kills: int, each: int, seconds: float, rng: random.Random) -> Tally:
    """Start a chain, kill it, start it again … and at last let it end; special kills are those of its group alone."""
    done, orphaning, wrong = 0, 0, []
    while done < kills:
        running, moment = chain.start(), time.monotonic() + rng.uniform(0.02, min(0.8, 2 / each)) * seconds  # spread over the chain
        while running.poll() is None and time.monotonic() < moment:
            time.sleep(0.01)
        if running.poll() is not None:
            if running.returncode:
                wrong.append(f"ended by itself: {chain.said()}")
            break
        everything = rng.random() < 0.5
        kill(running, everything)
        done, orphaning = done + 1, orphaning + (not everything)
        wrong += chain.broken()
        if everything and is_held(chain.root / "work/own/lock"):
            wrong.append("the lock is still held")
        print(f"  kill {done} of {kills} after {'everything' if everything else 'its group'} ran; {len(wrong)} wrong", flush=True)
    if chain.start().wait():
        wrong.append(f"did not end well: {chain.said()}")
    return Tally(done, orphaning, wrong + chain.broken())


def try_kills(chain: Chain, kills: int, each: int) -> list[Tally]:
    """Run a chain unkilled, a `RuntimeError` if it does not end well; then again and again with up to `each` kills, until there were
    `kills`."""
    rng, began = random.Random(0), time.monotonic()
    if chain.start().wait():
        raise RuntimeError(chain.said())
    expected, seconds = chain.outcome(), time.monotonic() - began

    def kill_one(number: int, kills: int) -> Tally:
        for folder in ("work", "results", ".snakemake"):
            shutil.rmtree(chain.root / folder, ignore_errors=True)
        tally, found = kill_at_random(chain, kills, each, seconds, rng), chain.outcome()
        tally.wrong.extend(f"{name} differs" for name in sorted(expected.keys() | found.keys()) if expected.get(name) != found.get(name))
        return tally

    return until_killed(kills, each, kill_one)


if __name__ == "__main__":
    note = "chains of all notebooks, {} kills left kernels behind; tables, prepared files, weights to the byte"
    sys.exit(count_kills(lambda root, *kills: try_kills(Chain.make(root), *kills), note, kills=20, each=10))
