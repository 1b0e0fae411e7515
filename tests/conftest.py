"""What all tests share."""

import os
import re
from pathlib import Path

os.environ.setdefault("OMP_WAIT_POLICY", "PASSIVE")  # before torch: spinning threads make a busy machine ten times slower
if "PYTEST_XDIST_WORKER" in os.environ:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the tests beside this one have the other cores

import numpy as np
import pytest
from loopback import bare_server  # noqa: F401
from small_encoder import save_encoder
from small_kitti import write_calibration, write_drive

REPOSITORY = Path(__file__).resolve().parents[1]
SLOW = (
    *("data_scripts/test_make_miniature.py", "data_scripts/test_miniature_geometry.py", "data_scripts/test_own_camera.py"),
    *("data_scripts/own/test_checks.py", "inference/test_export.py", "tables/test_table_backbone.py", "tables/test_table_sharpness.py"),
    *("tables/test_table_odometry.py", "tables/test_table_make3d.py", "tables/test_figures.py", "test_report.py"),
    *("data_scripts/test_export_labels.py", "data_scripts/own/test_camera.py"),
    "networks/test_encoders.py::test_any_hierarchical_backbone",
    "networks/test_encoders.py::test_imagenet_weights_are_taken_from_a_local_folder",
    "test_cli_evaluate.py::test_scores_need_no_torch",
    "test_model.py::test_disparities_are_the_networks_finest",
    "test_model.py::test_released_weights_give_their_network_back",
    "test_model.py::test_weights_that_are_not_of_the_cards_network",
    "test_model.py::test_what_sa_attention_does_is_read_from_the_card",
)
"""Files and tests that are slow, or share a slow fixture, or are many, beside those that say so themselves."""


def is_slow(path):
    """Whether all tests of a file are."""
    return path.as_posix().endswith(SLOW) or re.search(r"^pytestmark = .*mark\.slow", path.read_text(encoding="utf-8"), re.MULTILINE)


def pytest_ignore_collect(collection_path, config):
    """The fast ring does not even import slow files, some of which import much."""
    return True if "not slow" in config.option.markexpr and collection_path.suffix == ".py" and is_slow(collection_path) else None


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Mark these tests."""
    for item in items:
        if item.nodeid.removeprefix("tests/").startswith(SLOW):
            item.add_marker(pytest.mark.slow)


@pytest.fixture(autouse=True)
def all_notes():
    """Notes that an earlier test met are said again."""
    from dualdepth.errors import SAID

    SAID.clear()


@pytest.fixture(scope="session")
def encoder(tmp_path_factory):
    """A small ResNet, as folder for `encoder`."""
    return save_encoder(tmp_path_factory.mktemp("encoder"))


@pytest.fixture(scope="module")
def dual_of(encoder):
    """Makes a small dual network in training mode, always with the same weights."""

    def make(link="attention"):
        import torch  # a second, for the tests that need it
        from small_nets import with_heads

        from dualdepth.networks.depth_nets import DualNet, LRNet

        torch.manual_seed(0)
        return with_heads(DualNet(LRNet(encoder), link))

    return make


@pytest.fixture(scope="session")
def real():
    """Finds a file or folder of the real KITTI beside the repository, or skips the test. What is in it may change."""

    def find(path):
        found = REPOSITORY.parent / "shared" / "data" / path
        if not found.exists():
            pytest.skip(f"no real KITTI here ({found})")
        return found

    return find


@pytest.fixture
def checkout(tmp_path):
    """A folder that looks like a checkout."""
    root = tmp_path / "project"
    (root / "notebooks").mkdir(parents=True)
    (root / "Snakefile").touch()
    return root


@pytest.fixture
def refused(capsys):
    """Calls what must end with exit code 2, and print nothing but a progress bar; gives the one line that it says on stderr."""

    def call(command, *arguments, **settings):
        capsys.readouterr()
        with pytest.raises(SystemExit) as stop:
            command(*arguments, **settings)
        out, err = capsys.readouterr()
        said = err.splitlines()
        assert stop.value.code == 2 and (not out or "\r" in out) and len(said) == 1 and said[0].startswith("error: "), said
        return said[0]

    return call


@pytest.fixture
def kitti_root(tmp_path):
    """Root with one drive of five PNG frames of 208×208, and calibration."""
    root = tmp_path / "kitti"
    write_calibration(root)
    write_drive(root, range(5))
    return root


@pytest.fixture
def kitti_factory(tmp_path):
    """Makes a root with drives and their frame numbers, and the calibration of a laser that looks along the camera."""

    def make(drives):
        root = tmp_path / "kitti"
        write_calibration(root)
        camera = root / "2011_09_26" / "calib_cam_to_cam.txt"
        camera.write_text(camera.read_text() + "R_rect_00: 1 0 0 0 1 0 0 0 1\nS_rect_02: 208 208\n")
        (root / "2011_09_26" / "calib_velo_to_cam.txt").write_text("R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.27\n")
        for drive, frames in drives.items():
            write_drive(root, frames, drive)
        return root

    return make


@pytest.fixture
def write_scan():
    """Writes a scan of a wall 12 m ahead for a frame."""

    def write(root, drive, index):
        path = Path(root) / drive / "velodyne_points" / "data" / f"{index:010d}.bin"
        path.parent.mkdir(parents=True, exist_ok=True)
        left, up = np.meshgrid(np.linspace(-5, 5, 40), np.linspace(-5, 5, 40))
        np.stack([np.full(left.size, 12.0), left.ravel(), up.ravel(), np.ones(left.size)], 1).astype(np.float32).tofile(path)

    return write
