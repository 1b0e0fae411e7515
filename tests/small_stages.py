"""Both stages of small networks: alone, and as a run in which they are trained once for all tests."""

import json
import shutil

import pytest
import torch
from safetensors.torch import load_file
from small_kitti import DRIVE, write_calibration, write_drive

from dualdepth.profile import load_profile
from dualdepth.training.stages import Stage
from dualdepth.training.variants import train_variant
from tests.small_checkout import checkout_of, prepare

OTHER = "2011_09_26/2011_09_26_drive_0002_sync"
STEPS = 3
ONE_STEP = {"training.hr.max_steps": 1}


def stage_of(depth_net, pose_net, low, augment_first=True, channels_last=True, **loss):
    """A stage with the settings of `tiny` and these changes."""
    training = load_profile("tiny").training
    augmentation = training.augmentation.model_copy(update={"augment_first": augment_first})
    changes = {"loss": training.loss.model_copy(update=loss), "augmentation": augmentation, "channels_last": channels_last}
    return Stage(depth_net, pose_net, training.model_copy(update=changes), low=low)


def batch_of(items, size):
    """Noise, as a loader gives it."""
    images = torch.randint(0, 256, (items, 3, 3, *size), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    matrix = torch.tensor([[120.0, 0, 95.5], [0, 120, 47.5], [0, 0, 1]])
    return {"images": images, "intrinsics": matrix.expand(items, 3, 3), "name": ["a", "b"][:items]}


@pytest.fixture(scope="session")
def run_in(encoder):
    """A run in a folder that looks like a checkout, with changes of its profile."""

    def make(root, lr=None, train=None):
        stages = {"lr": lr or {"batch_size": 1, "max_steps": 2}, "hr": {"batch_size": 1, "epochs": 1}}
        train = train or {"lr": None, "dual": None, "dual_no_sa": None, "hr_only": ONE_STEP, "one_network": ONE_STEP}
        one = {"one_network": {"label": "one", "about": "one network", "network": "single"}}
        return checkout_of(root, encoder, stages, train=train, variants=one)

    return make


@pytest.fixture(scope="session")
def trained(run_in, tmp_path_factory):
    """A run whose `lr` was trained on one drive and whose `dual` on another; not to be changed."""
    root = tmp_path_factory.mktemp("checkout")
    kitti = root / "kitti"
    write_calibration(kitti)
    for drive in (DRIVE, OTHER):
        write_drive(kitti, range(STEPS + 2), drive)
    run = run_in(root)
    for drive, variant in ((DRIVE, "lr"), (OTHER, "dual")):
        prepare(run, drive)
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


def change_card(run, *without, **changes):
    """Change the card of stage 1's weights; some words are taken out."""
    path = run.weights("lr", 0).with_suffix(".json")
    card = json.loads(path.read_text()) | changes
    path.write_text(json.dumps({name: value for name, value in card.items() if name not in without}))
