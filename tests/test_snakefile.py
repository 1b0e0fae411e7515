"""The order of the chain and what makes a step stale, with a stand-in for the command that runs a notebook."""

import os
import shutil
import subprocess
import sys

import pytest

from dualdepth.config import PROFILES
from dualdepth.results import project_root

STAND_IN = """#!{python}
import pathlib, re, sys
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
name, profile = sys.argv[2], out.parts[1]
seed = re.search(r"seed=(\\d+)", " ".join(sys.argv))
made = {{
    "01_download_data": ["work/{{p}}/sources.json"],
    "02_prepare_data": ["work/{{p}}/prepared/" + n for n in ("triplets.csv", "identity.json", "test_frames.json", "ground_truth.npz")],
    "03_train_lr": ["work/{{p}}/runs/lr/seed{{s}}/trained.json"],
    "05_table_main": ["results/{{p}}/tables/main.csv", "results/{{p}}/tables/main.json"],
}}.get(name, [])
for path in [out, *(pathlib.Path(m.format(p=profile, s=seed and seed[1])) for m in made)]:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(" ".join(sys.argv))
with open("ran.txt", "a") as log:
    log.write(name + (" seed " + seed[1] if seed else "") + "\\n")
"""


@pytest.fixture
def chain(tmp_path):
    """Runs the chain of a profile in a folder of its own, and says which notebooks ran."""
    for name in ("Snakefile", "notebooks"):
        source = project_root() / name
        (shutil.copytree if source.is_dir() else shutil.copyfile)(source, tmp_path / name)
    command = tmp_path / "bin" / "dualdepth"
    command.parent.mkdir()
    command.write_text(STAND_IN.format(python=sys.executable))
    command.chmod(0o755)
    profile = tmp_path / "own.yaml"
    shutil.copyfile(PROFILES / "tiny.yaml", profile)

    def run(*config, change=None):
        if change:
            text = profile.read_text()
            assert change[0] in text
            profile.write_text(text.replace(*change))
        ran = tmp_path / "ran.txt"
        ran.unlink(missing_ok=True)
        environment = os.environ | {"PATH": f"{command.parent}:{os.environ['PATH']}", "PYTHONPATH": str(project_root())}
        words = [sys.executable, "-m", "snakemake", "--cores", "2", "--nolock", "--config", f"profile={profile}", *config]
        done = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return sorted(ran.read_text().splitlines()) if ran.exists() else []

    return run


def test_it_runs_everything_once_then_only_what_a_change_makes_stale(chain):
    everything = ["00_quickstart", "01_download_data", "02_prepare_data", "03_train_lr seed 0", "05_table_main"]
    assert chain() == everything
    assert chain() == []
    # another protocol: the table alone
    assert chain(change=("world:", "evaluation: {crop: none}\nworld:")) == ["05_table_main"]
    # another loss: the training and what follows
    assert chain(change=("  log_every: 5", "  loss: {smoothness: 0.2}\n  log_every: 5")) == ["03_train_lr seed 0", "05_table_main"]
    # one more seed: its training, and the table over both
    assert chain("seeds=0,1") == ["03_train_lr seed 1", "05_table_main"]
    # another world: all but the page that needs no data
    assert chain("seeds=0,1", change=("train_seed: 1", "train_seed: 3")) == [
        "01_download_data",
        "02_prepare_data",
        "03_train_lr seed 0",
        "03_train_lr seed 1",
        "05_table_main",
    ]


def test_how_often_the_log_is_written_makes_nothing_stale(chain):
    chain()
    assert chain(change=("  log_every: 5", "  log_every: 6")) == []


def test_seed_zero_alone_can_be_asked_for_in_a_profile_of_several(chain):
    ran = chain("seeds=0", change=("about:", "seeds: [0, 1, 2]\nabout:"))
    assert [name for name in ran if name.startswith("03")] == ["03_train_lr seed 0"]


def test_other_frames_to_score_leave_the_weights_where_they_are(chain, tmp_path):
    chain()
    weights = tmp_path / "work/own/runs/lr/seed0/model.safetensors"
    weights.write_text("learned")
    chain(change=("hr_size:", "baseline_frames: 3\n  hr_size:"))
    assert weights.read_text() == "learned"
