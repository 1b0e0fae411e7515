"""Both stages of small networks, trained once for all tests."""

import json
import shutil
from types import SimpleNamespace

import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors.torch import load_file
from small_encoder import save_encoder
from small_kitti import DRIVE, write_calibration, write_drive

from data_scripts.prepare_data import write_identity, write_training_index
from dualdepth.data.triplets import drive_triplets
from dualdepth.run import Run, Sources
from dualdepth.training.variants import train_variant

OTHER = "2011_09_26/2011_09_26_drive_0002_sync"
STEPS = 3
ONE_STEP = {"training.hr.max_steps": 1}


@pytest.fixture(autouse=True)
def quiet_torch():
    """Each training decides precision and determinism for itself."""
    yield
    AcceleratorState._reset_state(reset_partial_state=True)
    torch.use_deterministic_algorithms(False)


@pytest.fixture(scope="module")
def backbones(tmp_path_factory):
    """Folders of two small ResNets."""
    return SimpleNamespace(usual=save_encoder(tmp_path_factory.mktemp("usual")), other=save_encoder(tmp_path_factory.mktemp("other"), 80))


@pytest.fixture(scope="module")
def run_in(backbones):
    """A run in a folder that looks like a checkout, with changes of its profile."""

    def make(root, encoder=backbones.usual, hr_size=(192, 192), lr=None, train=None):
        values = {
            "about": "a test",
            "data": {"source": "kitti", "train_drives": [DRIVE], "hr_size": hr_size},
            "training": {
                **{"encoder": encoder, "pretrained": False, "workers": 0, "precision": "float32", "checkpoint_every": 2, "log_every": 1},
                "lr": lr or {"batch_size": 1, "max_steps": 2},
                "hr": {"batch_size": 1, "epochs": 1},
            },
            "train": train or {"lr": None, "dual": None, "dual_no_sa": None, "hr_only": ONE_STEP, "one_network": ONE_STEP},
            "variants": {"one_network": {"label": "one", "about": "one network", "network": "single"}},
        }
        (root / "notebooks").mkdir(exist_ok=True)
        (root / "Snakefile").touch()
        path = root / "own.yaml"
        path.write_text(json.dumps(values))  # JSON is YAML
        return Run(str(path), root)

    return make


@pytest.fixture(scope="module")
def trained(run_in, tmp_path_factory):
    """A run whose `lr` was trained on one drive and whose `dual` on another; not to be changed."""
    root = tmp_path_factory.mktemp("checkout")
    kitti = root / "kitti"
    write_calibration(kitti)
    for drive in (DRIVE, OTHER):
        write_drive(kitti, range(STEPS + 2), drive)
    run = run_in(root)
    Sources(kitti_root=kitti, test_list=root / "test_files.txt").save(run)
    for drive, variant in ((DRIVE, "lr"), (OTHER, "dual")):
        targets = drive_triplets(kitti, [drive])
        write_training_index(run, Sources.load(run), targets)
        write_identity(run, Sources.load(run), targets)
        assert train_variant(run, variant, 0) == run.weights(variant, 0)
    return run


@pytest.fixture
def after_stage_1(trained, run_in, tmp_path):
    """A copy of the run, before `dual`, with changes of its profile."""

    def make(name="copy", **changes):
        root = tmp_path / name
        shutil.copytree(trained.work, root / "work" / "own", ignore=shutil.ignore_patterns("dual"))
        return run_in(root, **changes)

    return make


def part(weights, prefix):
    """Tensors of a weights file whose names begin with `prefix`, without it."""
    return {name.removeprefix(prefix): value for name, value in load_file(weights).items() if name.startswith(prefix)}


def equal(a, b):
    return len(a) > 0 and a.keys() == b.keys() and all(torch.equal(v, b[k]) for k, v in a.items())


def change_card(run, **changes):
    path = run.weights("lr", 0).with_suffix(".json")
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))
