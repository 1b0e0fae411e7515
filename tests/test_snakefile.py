"""The order of the chain and what makes a step stale, with a stand-in for the command that runs a notebook."""

import pytest
from small_chain import SmallChain

from dualdepth.run import project_root

TABLES = sorted([path.stem for path in (project_root() / "notebooks").glob("*_table_*.ipynb")] + ["13_figures", "14_report"])
OF_DEPTH = [page for page in TABLES if page != "12_table_odometry"]
"""Pages that scored trainings of this profile."""


@pytest.fixture
def chain(tmp_path):
    """Runs the chain of a profile in a folder of its own, and says which notebooks ran."""
    return SmallChain.make(tmp_path)


def trainings(*seeds):
    return [f"{n} {v} seed {s}" for n, v in (("03_train_lr", "lr"), ("04_train_hr", "dual"), ("04_train_hr", "resnet18")) for s in seeds]


def test_it_runs_everything_once_then_only_what_a_change_makes_stale(chain):
    pages = ["00_quickstart", "01_download_data", "02_prepare_data"]
    assert chain() == sorted([*pages, *trainings(0), *TABLES])
    assert chain() == []
    # another protocol: the tables alone
    assert chain(change=("world:", "evaluation: {crop: none}\nworld:")) == TABLES
    # stage 2's settings: stage 2, the first page, which shows it, and the tables
    assert chain(change=("resnet18}", "resnet18, hr: {epochs: 7}}")) == sorted([pages[0], *trainings(0)[1:], *OF_DEPTH])
    # stage 1's: it, what starts from it, and the tables
    assert chain(change=("hr: {epochs: 7}", "hr: {epochs: 7}, lr: {epochs: 7}")) == sorted([pages[0], *trainings(0)[:2], *OF_DEPTH])
    # another loss: all trainings
    assert chain(change=("lr: {epochs: 7}", "lr: {epochs: 7}, loss: {smoothness: 0.2}")) == sorted([pages[0], *trainings(0), *OF_DEPTH])
    # one more seed: its trainings, and the tables over both
    assert chain("seeds=0,1") == sorted([*trainings(1), *TABLES])
    # one variant less: what shows it
    assert "04_train_hr" not in " ".join(chain("seeds=0,1", change=(", resnet18: }", "}")))
    # another world: all
    ran = chain("seeds=0,1", change=("world: {}", "world: {train_seed: 3}"))
    assert ran == sorted([*pages, *(t for t in trainings(0, 1) if "resnet18" not in t), *TABLES])


def test_how_often_the_log_is_written_makes_nothing_stale(chain):
    chain()
    assert chain(change=("resnet18}", "resnet18, log_every: 6}")) == []


def test_seed_zero_alone_can_be_asked_for_in_a_profile_of_several(chain):
    ran = chain("seeds=0", change=("about:", "seeds: [0, 1, 2]\nabout:"))
    assert [name for name in ran if name.startswith(("03", "04"))] == trainings(0)


def test_other_frames_to_score_leave_the_weights_where_they_are(chain, tmp_path):
    chain()
    weights = tmp_path / "work/own/runs/lr/seed0/model.safetensors"
    weights.write_text("learned")
    chain(change=("source: miniature", "source: miniature, baseline_frames: 3"))
    assert weights.read_text() == "learned"


def test_a_profile_that_trains_stage_1_alone_has_its_tables(chain):
    ran = chain(change=("train: {lr: , dual: , resnet18: }", "train: {lr: }"))
    assert [name for name in ran if name.startswith(("03", "04"))] == trainings(0)[:1]
    assert set(TABLES) <= set(ran)


ODOMETRY = ("train: {lr: , dual: , resnet18: }", "train: {lr: , odometry_lr: }")
KITTI = ("world: {}\ndata: {source: miniature}", "data: {source: kitti, train_drives: [d]}")


def test_odometry_is_trained_on_triplets_of_its_own(chain, tmp_path):
    chain(change=ODOMETRY)
    weights = tmp_path / "work/own/runs/odometry_lr/seed0/trained.json"
    assert weights.exists()
    (tmp_path / "work/own/prepared/odometry.csv").write_text("others")
    assert {"03_train_lr odometry_lr seed 0", "12_table_odometry"} <= set(chain()) and "03_train_lr lr seed 0" not in chain()


def test_a_data_set_of_an_own_camera_made_anew_in_its_folder_is_prepared_anew(chain, tmp_path):
    own = ("world: {}\ndata: {source: miniature}", "data: {source: own}")
    (tmp_path / "film").mkdir()
    (tmp_path / "film/own.json").write_text("one")
    chain(f"kitti_root={tmp_path / 'film'}", change=own)
    (tmp_path / "film/own.json").write_text("another")
    assert {"01_download_data", "02_prepare_data", "03_train_lr lr seed 0"} <= set(chain(f"kitti_root={tmp_path / 'film'}"))


def test_without_its_folder_odometry_is_not_trained_but_has_its_table(chain, tmp_path):
    profile = tmp_path / "own.yaml"
    profile.write_text(profile.read_text().replace(*KITTI))
    ran = chain(change=ODOMETRY)
    assert [name for name in ran if name.startswith("03")] == ["03_train_lr lr seed 0"] and "12_table_odometry" in ran
    assert "03_train_lr odometry_lr seed 0" in chain("odometry_root=/somewhere")


def test_a_result_that_was_deleted_is_made_again(chain, tmp_path):
    chain()
    (tmp_path / "results/own/tables/main.csv").unlink()
    assert chain() == ["05_table_main", "14_report"]
    (tmp_path / "results/own/report.html").unlink()
    assert chain() == ["14_report"]


def test_every_notebook_is_in_the_chain(chain):
    named = {path.stem for path in (project_root() / "notebooks").glob("*.ipynb")}
    assert named == {line.split()[0] for line in chain()}


def test_replaced_files_of_a_folder_make_their_page_stale(chain, tmp_path):
    profile = tmp_path / "own.yaml"
    profile.write_text(profile.read_text().replace(*KITTI))
    grids = tmp_path / "make3d" / "Gridlaserdata"
    grids.mkdir(parents=True)
    (grids / "a.mat").write_text("one")
    given = f"make3d_root={tmp_path / 'make3d'}"
    chain(given)
    assert chain(given) == []
    (grids / "a.mat").write_text("another")
    assert chain(given) == ["06_table_make3d", "14_report"]


def test_the_cluster_profile_is_one_that_snakemake_takes(chain):
    """A dry run; the SLURM plugin itself is not installed here."""
    settings = project_root() / "cluster" / "slurm"
    assert "executor: slurm" in (settings / "config.yaml").read_text()
    assert chain("--profile", str(settings), "--executor", "local", "--dry-run") == []
    assert chain() != []  # it had only been planned
