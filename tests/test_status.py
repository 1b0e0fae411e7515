"""What `dualdepth status` says of a chain: in which state each step is, and why."""

import json
import os
import shutil
import subprocess
import sys
from base64 import urlsafe_b64encode

import pytest
import yaml
from dualdepth.status import chain_steps
from small_chain import PROFILE, SmallChain

from dualdepth import staleness
from dualdepth.cli import main
from dualdepth.files import locked
from dualdepth.profile import Profile
from dualdepth.run import Run

TRAININGS = {"03_train_lr_lr_seed0", "04_train_hr_dual_seed0", "04_train_hr_resnet18_seed0"}


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A chain that has run to its end."""
    chain = SmallChain.make(tmp_path_factory.mktemp("finished"))
    chain()
    return chain


@pytest.fixture
def chain(finished, tmp_path, monkeypatch):
    """A copy of it to change, as the current folder."""
    shutil.copytree(finished.root, tmp_path / "copy", symlinks=True)
    monkeypatch.chdir(tmp_path / "copy")
    return SmallChain(tmp_path / "copy")


def states(chain, **config):
    """`{name: (state, why)}` of all steps."""
    steps = chain_steps(Run(str(chain.profile), chain.root), {"profile": str(chain.profile), **config})
    return {step.name: (step.state, step.why) for step in steps}


def stale(chain, **config):
    """`{name: why}` of what is not done; all of it is stale."""
    found = {name: step for name, step in states(chain, **config).items() if step[0] != "done"}
    assert {state for state, _ in found.values()} <= {"stale"}
    return {name: why for name, (_, why) in found.items()}


def tree(root):
    return {path: path.lstat().st_mtime_ns for path in root.rglob("*")}


def test_of_a_fresh_checkout_all_is_missing_and_nothing_is_written(tmp_path, monkeypatch, capsys):
    chain = SmallChain.make(tmp_path)
    monkeypatch.chdir(tmp_path)
    before = tree(tmp_path)
    assert main(["status", "--profile", str(chain.profile)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[-1] == "profile own: 0 done, 0 stale, 16 missing, 0 running, of 16 steps"
    assert {line.split()[0] for line in lines[:-1]} == {"missing"}
    assert {line.split()[1][:2] for line in lines[:-1]} == {path.name[:2] for path in (tmp_path / "notebooks").iterdir()}
    assert tree(tmp_path) == before


def test_a_chain_at_its_end_is_done(chain):
    before = tree(chain.root)
    assert set(states(chain).values()) == {("done", "")}
    assert tree(chain.root) == before


def test_a_changed_setting_is_named_with_its_values_and_makes_its_steps_stale(chain):
    chain.change("resnet18}", "resnet18, hr: {epochs: 7}}")
    found = stale(chain)
    epochs = Profile.model_validate(yaml.safe_load(PROFILE) | {"name": "own"}).training.hr.epochs
    assert found["04_train_hr_dual_seed0"] == f"setting training.hr.epochs: {epochs} → 7"
    assert "03_train_lr_lr_seed0" not in found and "12_table_odometry" not in found
    assert found["10_table_sa_region"] == "waits for 04_train_hr_dual_seed0"
    assert found["13_figures"] == "waits for 04_train_hr_dual_seed0"


def test_changed_code_is_named_by_its_module(chain, monkeypatch):
    of = staleness._code
    monkeypatch.setattr(staleness, "_code", lambda *steps: of(*steps) | ({"hr_stage": "other"} if "train_hr" in steps else {}))
    found = stale(chain)
    assert {name for name, why in found.items() if why == "code hr_stage changed"} == TRAININGS - {"03_train_lr_lr_seed0"}
    assert "03_train_lr_lr_seed0" not in found


def test_a_changed_notebook_makes_its_page_stale_and_the_report(chain):
    notebook = chain.root / "notebooks/05_table_main.ipynb"
    content = json.loads(notebook.read_text())
    content["cells"][-1] = {"cell_type": "code", "source": ["1 + 1"], "metadata": {}, "outputs": [], "execution_count": None}
    notebook.write_text(json.dumps(content))
    assert stale(chain) == {"05_table_main": "notebook 05_table_main changed", "14_report": "waits for 05_table_main"}


def test_a_changed_input_is_named(chain):
    (chain.root / "work/own/prepared/triplets.csv").write_text("others")
    found = stale(chain)
    assert found["03_train_lr_lr_seed0"] == "work/own/prepared/triplets.csv changed"
    assert found["05_table_main"] == "waits for 03_train_lr_lr_seed0, 04_train_hr_dual_seed0"


def test_a_folder_given_anew_is_named(chain):
    found = stale(chain, make3d_root="/data/make3d")
    assert found["01_download_data"] == "given make3d_root: none → /data/make3d"


def test_other_seeds_are_missing_trainings_and_stale_tables(chain):
    found = states(chain, seeds="0,1")
    assert {name for name, (state, _) in found.items() if state == "missing"} == {name.replace("seed0", "seed1") for name in TRAININGS}
    assert found["05_table_main"][0] == "stale" and "given seeds: 0 → 0,1" in found["05_table_main"][1]


def test_a_table_that_was_deleted_is_named(chain):
    (chain.root / "results/own/tables/main.csv").unlink()
    found = states(chain)
    assert found["05_table_main"] == ("missing", "results/own/tables/main.csv not there")
    assert found["14_report"] == ("stale", "waits for 05_table_main")


def test_what_the_last_run_was_given_holds_for_status_too(chain, tmp_path, capsys):
    """Seeds and folders are given to `reproduce` once; `status` alone then calls nothing stale."""
    command = [sys.executable, "-m", "dualdepth.cli", "reproduce", "--profile", str(chain.profile), "--seeds", "0,1"]
    environment = os.environ | {"PATH": f"{chain.root / 'bin'}:{os.environ['PATH']}"}
    subprocess.run(command, cwd=chain.root, env=environment, check=True, capture_output=True)
    main(["status", "--profile", str(chain.profile)])
    assert capsys.readouterr().out.splitlines()[-1] == "profile own: 19 done, 0 stale, 0 missing, 0 running, of 19 steps"
    main(["status", "--profile", str(chain.profile), "--seeds", "0"])
    assert " 0 done" not in (last := capsys.readouterr().out.splitlines()[-1]) and " 0 stale" not in last


def begin(chain, name):
    """Leave a step as a run leaves it that is at work on it, or was killed there: marked, its outputs gone."""
    for file in (f"results/own/notebooks/{name}.ipynb", "work/own/runs/lr/seed0/trained.json"):
        (chain.root / file).unlink()
        (chain.root / ".snakemake/incomplete" / urlsafe_b64encode(file.encode()).decode()).touch()


def test_a_training_at_work_says_how_far_it_is_and_a_killed_one_where_it_stopped(chain, capsys):
    name, folder = "03_train_lr_lr_seed0", chain.root / "work/own/runs/lr/seed0"
    begin(chain, name)
    assert states(chain)[name] == ("missing", "its last run was broken off")
    (folder / "log.csv").write_text("step,loss\n1,0.5\n6,0.4\n")
    (folder / "checkpoint_00000004.pt").touch()
    (chain.root / "work/own/prepared/triplets.csv").write_text("drive,camera,index,suffix\n" + "d,image_02,1,.png\n" * 80)
    run = Run(str(chain.profile), chain.root)
    of = f"step 6 of {run.profile.training.lr.epochs * (80 // run.profile.training.lr.batch_size)}"
    assert states(chain)[name] == ("missing", f"stopped at {of}")
    with locked(run.work / "lock"):
        assert states(chain)[name] == ("running", of)
        main(["status", "--profile", str(chain.profile)])
        assert "1 running, of 16 steps; process " in capsys.readouterr().out


def test_a_training_by_hand_is_running_too(chain):
    run = Run(str(chain.profile), chain.root)
    with locked(run.training("lr", 0) / "lock"):
        state, why = states(chain)["03_train_lr_lr_seed0"]
    assert state == "running" and "process " in why
