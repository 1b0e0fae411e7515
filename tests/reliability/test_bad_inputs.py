"""Every bad input ends in exit code 2 and one line that names the file, and leaves nothing behind; what is only odd works.

Files and folders without permission are bad inputs too, also where the tests run as root.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest
from bad_inputs import CASES, Case
from worlds import CAMERAS, DRIVE, SCAN, SERVED, WORLDS

from data_scripts import download_make3d
from dualdepth.cli import main
from dualdepth.errors import InputError
from dualdepth.run import parse_seeds

pytestmark = pytest.mark.slow
EXPORT = str(Path(__file__).parents[2] / "data_scripts/export_depth.py")
LOGS = ("log.csv", "events.out.tfevents", "panels", "seed0/lock")
"""What a training writes before it reads its first frame."""


@pytest.fixture
def server(bare_server, monkeypatch):
    monkeypatch.setattr(download_make3d, "MAKE3D_PHOTOS", 1)
    return bare_server


def call_of(case: Case, folder: Path, server):
    """The command of a case, with its one file damaged."""
    if case.world in SERVED:
        call = SERVED[case.world](folder, server)
        server.files[case.file] = case.damage(server.files[case.file])
        return call
    call = WORLDS[case.world](folder)
    path = folder / case.file
    content = case.damage(path.read_bytes() if path.exists() else b"")
    if content is None:
        path.unlink()
    else:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_bytes(content)
    return call


def files(folder: Path) -> set[str]:
    """All files but a training's logs."""
    found = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    return {name for name in found if not any(log in name for log in LOGS)}


def lines(err: str) -> list[str]:
    """Lines on stderr that are no progress bar."""
    return [line for line in err.replace("\r", "\n").splitlines() if line.strip() and "%|" not in line]


@pytest.mark.parametrize("case", CASES, ids=lambda case: f"{case.world}-{Path(case.file).name}-{case.what}".replace(" ", "_"))
def test_the_table(case, tmp_path, monkeypatch, server, capfd, recwarn, counted):
    monkeypatch.chdir(tmp_path)
    call = call_of(case, tmp_path, server)
    before = files(tmp_path)
    capfd.readouterr()
    recwarn.clear()
    with counted():
        if case.works:
            assert not call()
            return
        with pytest.raises(SystemExit) as stop:
            call()
        said = lines(capfd.readouterr().err)
        warned = [w.message for w in recwarn.list if not issubclass(w.category, (ResourceWarning, pytest.PytestUnraisableExceptionWarning))]
        assert stop.value.code == 2 and not warned
        assert len(said) == 1 and said[0].startswith("error: "), said
        assert (case.named or Path(case.file).name) in said[0]
        assert {name for name in files(tmp_path) - before if not name.startswith(case.leaves)} == set() and before <= files(tmp_path)


@pytest.mark.parametrize("world", [*WORLDS, *SERVED])
def test_folders_with_spaces_and_other_letters_work(world, tmp_path, monkeypatch, server, counted):
    folder = tmp_path / "mein Ordner ñ 深度 'x'"
    folder.mkdir()
    monkeypatch.chdir(folder)
    with counted():
        assert not (SERVED[world](folder, server) if world in SERVED else WORLDS[world](folder))()


@pytest.mark.parametrize(
    ("world", "file", "command"),
    [
        ("depth", "G.npz", "-m dualdepth.cli evaluate depth --pred P.npy --gt G.npz"),
        ("scans", "list.txt", f"{EXPORT} --kitti kitti --list list.txt --out out.npz"),
        ("PNG frames", "own.yaml", "-m dualdepth.cli train --profile own.yaml"),
    ],
)
def test_as_a_process(world, file, command, tmp_path, monkeypatch, counted):
    monkeypatch.chdir(tmp_path)
    WORLDS[world](tmp_path)
    (tmp_path / file).write_bytes(b"\xff\xfe damaged")
    with counted():
        done = subprocess.run([sys.executable, *command.split()], capture_output=True, text=True, check=False)
        assert done.returncode == 2 and done.stdout == ""
        assert len(done.stderr.splitlines()) == 1 and done.stderr.startswith("error: ") and file in done.stderr


DENIED = [
    *[("scans", name) for name in ("list.txt", SCAN, CAMERAS, f"kitti/{DRIVE}/image_02/data", ".")],
    *[("improved", "improved"), ("depth", "P.npy"), ("depth", "G.npz"), ("odometry", "pred.txt"), ("labels", "labels.png")],
    *[("PNG frames", name) for name in ("own.yaml", "work/own/prepared/triplets.csv", "work/own/runs/lr/seed0")],
]
"""What is read, and which file or folder of it may not be touched; `.` is the folder to write to."""


@contextlib.contextmanager
def without_rights():
    """Inside, root is nobody, who may not touch what is closed."""
    user = os.geteuid()
    try:
        os.seteuid(user or 65534)
    except OSError:
        pytest.skip("the rights of root cannot be given up here")
    try:
        yield
    finally:
        os.seteuid(user)


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


@pytest.mark.parametrize("seed", ["-1", "4294967296"])
def test_a_seed_that_is_none_is_refused(seed, refused):
    assert refused(main, ["train", "--seed", seed]) == f"error: --seed {seed}: give a whole number from 0 to 4294967295"
    for text in (f"0,{seed}", "0,0", "0,,1"):
        with pytest.raises(InputError, match="from 0 to 4294967295"):
            parse_seeds(text)
