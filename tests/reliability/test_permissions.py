"""Files and folders without permission: exit code 2 and one line that names them, also where the tests run as root."""

import contextlib
import os
import tempfile
from pathlib import Path

import pytest
from worlds import CAMERAS, DRIVE, SCAN, WORLDS

pytestmark = pytest.mark.slow

NOBODY = 65534
DENIED = [
    ("scans", "list.txt"),
    ("scans", SCAN),
    ("scans", CAMERAS),
    ("scans", f"kitti/{DRIVE}/image_02/data"),
    ("scans", "."),
    ("improved", "improved"),
    ("depth", "P.npy"),
    ("depth", "G.npz"),
    ("odometry", "pred.txt"),
    ("labels", "labels.png"),
    ("PNG frames", "own.yaml"),
    ("PNG frames", "work/own/prepared/triplets.csv"),
    ("PNG frames", "work/own/runs/lr/seed0"),
]
"""What is read, and which file or folder of it may not be touched; `.` is the folder to write to."""


@contextlib.contextmanager
def without_rights():
    """Inside, root is nobody, who may not touch what is closed."""
    root = os.geteuid() == 0
    try:
        os.seteuid(NOBODY if root else os.geteuid())
    except OSError:
        pytest.skip("the rights of root cannot be given up here")
    try:
        yield
    finally:
        if root:
            os.seteuid(0)


@pytest.mark.parametrize(("world", "name"), DENIED)
def test_what_may_not_be_touched_is_named_in_one_line(world, name, monkeypatch, refused, counted):
    with tempfile.TemporaryDirectory() as place:  # below no folder of pytest's, which are closed to other users
        folder = Path(place)
        monkeypatch.chdir(folder)
        call = WORLDS[world](folder)
        assert not call()  # with all rights it works, and has imported what it needs
        for written in ("out.npz", "out.json"):
            (folder / written).unlink(missing_ok=True)
        folder.chmod(0o777)
        (folder / name).chmod(0o555 if name == "." else 0)
        before = set(os.listdir())
        with counted(), without_rights():
            assert {".": "out."}.get(name, name) in refused(call)
        assert set(os.listdir()) == before
        (folder / name).chmod(0o755)
        monkeypatch.undo()
