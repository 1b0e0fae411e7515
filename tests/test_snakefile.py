"""The order of the chain and what makes a step stale, with a stand-in for the command that runs a notebook."""

import os
import re
import shlex
import shutil
import subprocess
import sys

import pytest
from small_chain import SmallChain

from dualdepth.cli import main
from dualdepth.files import locked
from dualdepth.run import project_root

pytestmark = pytest.mark.slow
TABLES = sorted([path.stem for path in (project_root() / "notebooks").glob("*_table_*.ipynb")] + ["13_figures", "14_report"])


def test_a_profile_named_without_its_option_is_no_step(capsys):
    with pytest.raises(SystemExit):
        main(["reproduce", "--cores", "1", "tiny"])
    assert "write --profile tiny" in capsys.readouterr().err


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    """A chain that has run to its end."""
    chain = SmallChain.make(tmp_path_factory.mktemp("finished"))
    chain()
    return chain


@pytest.fixture
def chain(finished, tmp_path):
    """A copy of it to change."""
    return finished.copy(tmp_path)


@pytest.fixture
def fresh(tmp_path):
    """A chain that has not run."""
    return SmallChain.make(tmp_path)


def trainings(*seeds):
    return [f"{n} {v} seed {s}" for n, v in (("03_train_lr", "lr"), ("04_train_hr", "dual"), ("04_train_hr", "resnet18")) for s in seeds]


def test_it_runs_everything_once_then_only_what_a_change_makes_stale(chain):
    pages = ["00_quickstart", "01_download_data", "02_prepare_data"]
    assert chain.ran() == sorted([*pages, *trainings(0), *TABLES])
    assert {line.split()[0] for line in chain.ran()} == {path.stem for path in (project_root() / "notebooks").glob("*.ipynb")}
    # how often the log is written: nothing, as without any change
    assert chain(change=("{encoder: resnet18", "{log_every: 6, encoder: resnet18")) == []
    # another protocol: the tables alone
    assert chain(change=("world:", "evaluation: {crop: none}\nworld:")) == TABLES
    # stage 1's settings: it, what starts from it, the first page, which shows that, and the tables
    assert chain(change=("resnet18}", "resnet18, lr: {epochs: 7}}")) == sorted([pages[0], *trainings(0)[:2], *TABLES])
    # one more seed: its trainings, and the tables over both
    assert chain("seeds=0,1") == sorted([*trainings(1), *TABLES])
    # one variant less: what shows it
    assert "04_train_hr" not in " ".join(chain("seeds=0,1", change=(", resnet18: }", "}")))
    # another world: all; what a training has learned so far stays
    weights = chain.root / "work/own/runs/lr/seed0/model.safetensors"
    weights.write_text("learned")
    ran = chain("seeds=0,1", change=("world: {}", "world: {train_seed: 3}"))
    assert ran == sorted([*pages, *(t for t in trainings(0, 1) if "resnet18" not in t), *TABLES])
    assert weights.read_text() == "learned"


@pytest.mark.parametrize(
    ("config", "change", "trained"),
    [(["seeds=0"], ("about:", "seeds: [0, 1, 2]\nabout:"), 3), ([], ("train: {lr: , dual: , resnet18: }", "train: {lr: }"), 1)],
    ids=["seed 0 of a profile of several", "stage 1 alone"],
)
def test_a_part_of_the_trainings_has_all_tables(fresh, config, change, trained):
    ran = fresh(*config, change=change)
    assert [name for name in ran if name.startswith(("03", "04"))] == trainings(0)[:trained]
    assert set(TABLES) <= set(ran)


ODOMETRY = ("train: {lr: , dual: , resnet18: }", "train: {lr: , odometry_lr: }")
KITTI = ("world: {}\ndata: {source: miniature}", "data: {source: kitti, train_drives: [d]}")


def test_odometry_is_trained_on_triplets_of_its_own_but_without_its_folder_has_a_table_alone(fresh, tmp_path):
    """A last run finds other triplets, and other files in a folder that was given."""
    grids = tmp_path / "make3d" / "Gridlaserdata"
    grids.mkdir(parents=True)
    (grids / "a.mat").write_text("one")
    given = "odometry_root=/somewhere", f"make3d_root={tmp_path / 'make3d'}"
    fresh.change(*KITTI)
    ran = fresh(change=ODOMETRY)
    assert [name for name in ran if name.startswith("03")] == ["03_train_lr lr seed 0"] and "12_table_odometry" in ran
    assert "03_train_lr odometry_lr seed 0" in fresh(*given)
    (tmp_path / "work/own/prepared/odometry.csv").write_text("others")
    (grids / "a.mat").write_text("another")
    assert fresh(*given) == ["03_train_lr odometry_lr seed 0", "06_table_make3d", "12_table_odometry", "14_report"]


def test_another_list_of_frames_in_the_same_file_is_prepared_anew(fresh, tmp_path):
    fresh.change(*KITTI)
    for frames in ("one", "another"):
        (tmp_path / "frames.txt").write_text(frames)
        assert "02_prepare_data" in fresh(f"test_list={tmp_path / 'frames.txt'}")
    assert fresh(f"test_list={tmp_path / 'frames.txt'}") == []


def test_a_data_set_of_an_own_camera_made_anew_in_its_folder_is_prepared_anew(fresh, tmp_path):
    own = ("world: {}\ndata: {source: miniature}", "data: {source: own}")
    (tmp_path / "film").mkdir()
    (tmp_path / "film/own.json").write_text("one")
    fresh(f"kitti_root={tmp_path / 'film'}", change=own)
    (tmp_path / "film/own.json").write_text("another")
    assert {"01_download_data", "02_prepare_data", "03_train_lr lr seed 0"} <= set(fresh(f"kitti_root={tmp_path / 'film'}"))


def test_the_cluster_profile_is_one_that_snakemake_takes(fresh):
    """A dry run; the SLURM plugin itself is not installed here."""
    settings = project_root() / "cluster" / "slurm"
    assert "executor: slurm" in (settings / "config.yaml").read_text()
    assert fresh("--profile", str(settings), "--executor", "local", "--dry-run") == []


def test_a_dry_run_names_a_changed_setting_with_both_values_and_what_follows_from_it(chain):
    chain.change("resnet18}", "resnet18, hr: {epochs: 7}}")
    with locked(chain.root / "work/own/lock"):  # which a dry run does not need
        why = chain.would_run()
    changed = r"before: \('setting training\.hr\.epochs', \d+\) now: \('setting training\.hr\.epochs', 7\)"
    assert {name for name, reason in why.items() if re.search(changed, reason)} == {"train_dual", "train_resnet18"}
    assert "train_lr" not in why and {"quickstart", "report", *TABLES[:-1]} <= why.keys()
    assert "work/own/runs/dual/seed0/trained.json" in why["10_table_sa_region"]


def test_a_dry_run_names_changed_code_by_its_folder_and_a_changed_notebook(chain):
    for folder in ("dualdepth", "data_scripts"):  # before those that PYTHONPATH names
        shutil.copytree(project_root() / folder, chain.root / folder)
    for file, more in (("evaluation/depth.py", "X = 1\n"), ("training/loop.py", "# a comment\n")):
        (chain.root / "dualdepth" / file).open("a").write(more)
    notebook = chain.root / "notebooks/06_table_make3d.ipynb"
    notebook.write_text(notebook.read_text().replace("profile = ", "profile =  "))
    why = chain.would_run()
    assert "('code evaluation', " in why["05_table_main"] and not {"download_data", "train_lr", "train_dual"} & why.keys()
    assert "('notebook 06_table_make3d', " in why["06_table_make3d"]


def test_a_run_ends_with_where_its_results_are_or_with_one_line_of_error(chain):
    done = chain.reproduce()
    assert (done.returncode, done.stdout, done.stderr) == (0, "profile own: a test; results in results/own\n", "")
    (chain.root / "results/own/report.html").unlink()
    done = chain.reproduce()
    assert done.returncode == 0 and "results/own/report.html" in done.stdout.splitlines()[-1]
    command = chain.root / "bin/dualdepth"
    command.write_text(f"#!{sys.executable}\nraise SystemExit('error: a mistake')\n")
    chain.change("world: {}", "world: {train_seed: 3}")
    done = chain.reproduce()
    assert done.returncode == 1 and [line[:24] for line in done.stderr.splitlines()] == ["error: a mistake", "error: the chain stopped"]
    (chain.root / "other").mkdir()
    other = SmallChain(chain.root)
    other.profile = shutil.copy(chain.profile, chain.root / "other")
    assert "other/own.yaml: work/own and results/own are of own.yaml; give" in (done := other.reproduce()).stderr and done.returncode == 2
    (chain.root / ".snakemake").rename(chain.root / "elsewhere")
    (chain.root / ".snakemake").touch()
    done = chain.reproduce()
    assert done.returncode == 2 and ".snakemake: nothing can be written there" in done.stderr


def test_folders_of_any_name_reach_the_notebooks_and_a_home_that_cannot_be_written_is_not_needed(fresh, tmp_path):
    odd = tmp_path / """a #1: 'q' "d" ü $HOME $(x) %d \\n {x} 😀"""
    (odd / "2011_09_26").mkdir(parents=True)
    (odd / "2011_09_26/calib_cam_to_cam.txt").touch()
    fresh.environment |= {"HOME": "/proc/none", "PATH": f"{tmp_path / 'bin'}:{os.environ['PATH']}"}
    shutil.copyfile(project_root() / "Makefile", tmp_path / "Makefile")
    words = ["make", "--no-print-directory", "-n", "reproduce", "STAMP=", "VENV=x", f"PROFILE={fresh.profile}"]
    words += [f"KITTI_ROOT={odd}".replace("$", "$$")]
    assert shlex.split(subprocess.check_output(words, cwd=tmp_path, text=True).splitlines()[-1])[5] == str(odd).replace("$", "$$")
    assert fresh.reproduce("--kitti-root", str(odd)).returncode == 0
    assert f" kitti_root={odd} test_list= " in (tmp_path / "work/own/sources.json").read_text()


@pytest.mark.parametrize("dry", [[], ["--dry-run"]])
def test_what_is_wrong_with_the_chain_itself_is_one_line(fresh, dry):
    assert fresh.reproduce("--", "--until", "x", *dry).stderr.startswith("error: Snakefile: MissingRuleException: No rule to produce x ")
    (fresh.root / "Snakefile").open("a").write("\nraise ValueError('a\\nmistake')\n")
    assert fresh.reproduce("--", *dry).stderr == "error: Snakefile: ValueError: a mistake\n"
