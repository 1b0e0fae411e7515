"""The download script, run in-process against a server on loopback that holds a toy KITTI."""

import hashlib
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import pytest
from loopback import files, zip_of

from data_scripts import download_kitti as script
from data_scripts import sources

DAY, DRIVE = "2011_09_26", "2011_09_26_drive_0095_sync"
CALIB_ADDRESS = "raw_data/2011_09_26_calib.zip"
DRIVE_ADDRESS = "raw_data/2011_09_26_drive_0095/2011_09_26_drive_0095_sync.zip"
EIGEN = (
    b"2011_09_26/2011_09_26_drive_0095_sync 0000000000 l\n"
    b"2011_09_26/2011_09_26_drive_0052_sync 0000000003 l\n"
    b"2011_09_26/2011_09_26_drive_0013_sync 0000000001 r\n"
)


def drive_zip(name):
    members = {f"{DAY}/{name}/image_0{camera}/data/0000000000.png": bytes([camera]) * 20000 for camera in range(4)}
    members[f"{DAY}/{name}/velodyne_points/data/0000000000.bin"] = b"laser scan"
    return zip_of(members)


@pytest.fixture
def server(bare_server):
    bare_server.files[CALIB_ADDRESS] = zip_of({f"{DAY}/calib_cam_to_cam.txt": b"P_rect_02: 1 0 0\n"})
    for number in ("0095", "0052", "0013"):
        name = f"{DAY}_drive_{number}"
        bare_server.files[f"raw_data/{name}/{name}_sync.zip"] = drive_zip(f"{name}_sync")
    return bare_server


@pytest.fixture
def lists(server, monkeypatch):
    """The field's lists on the server, shortened, with checksums to match."""
    for name, entry in sources.LISTS.items():
        monkeypatch.setitem(sources.LISTS, name, entry._replace(sha256=hashlib.sha256(EIGEN).hexdigest()))
        server.files[entry.path] = EIGEN


def run(server, root, *arguments):
    return script.main(["--root", str(root), *arguments], kitti_home=server.home, lists_home=server.home)


def test_a_drive_comes_with_its_calibration_and_nothing_else_is_left(server, tmp_path, capsys):
    run(server, tmp_path, f"{DAY}/{DRIVE}")
    assert files(tmp_path) == [
        f"{DAY}/.calib.complete.json",
        f"{DAY}/{DRIVE}/.complete.json",
        *(f"{DAY}/{DRIVE}/image_0{camera}/data/0000000000.png" for camera in range(4)),
        f"{DAY}/{DRIVE}/velodyne_points/data/0000000000.bin",
        f"{DAY}/calib_cam_to_cam.txt",
    ]
    said = capsys.readouterr().out
    assert not (tmp_path / "archives").exists()
    assert f"2/2 {DRIVE}.zip: 100%" in said and "B/s]" in said and f"KITTI_ROOT={tmp_path}" in said
    server.requests.clear()
    run(server, tmp_path, DRIVE)
    assert server.requests == []


def test_cameras_that_are_not_wanted_are_left_out_and_can_be_added(server, tmp_path):
    run(server, tmp_path, DRIVE, "--cameras", "image_02", "image_03")
    drive = tmp_path / DAY / DRIVE
    assert sorted(path.name for path in drive.iterdir()) == [".complete.json", "image_02", "image_03", "velodyne_points"]
    server.requests.clear()
    run(server, tmp_path, DRIVE, "--cameras", "image_03")
    assert server.requests == []
    run(server, tmp_path, DRIVE, "--cameras", "image_00")
    assert json.loads((drive / ".complete.json").read_text())["cameras"] == ["image_00", "image_02", "image_03"]
    assert {path for _, path, _, _ in server.requests} == {DRIVE_ADDRESS}


def test_archives_are_kept_on_demand_and_used_again(server, tmp_path):
    run(server, tmp_path, DRIVE, "--keep-archives")
    assert files(tmp_path / "archives") == ["2011_09_26_calib.zip", f"{DRIVE}.zip"]
    shutil.rmtree(tmp_path / DAY)
    server.requests.clear()
    run(server, tmp_path, DRIVE, "--keep-archives")
    assert server.sent == [] and (tmp_path / DAY / DRIVE / "image_02").is_dir()


def test_a_disk_that_is_too_small_or_a_missing_archive_is_told_before_anything_is_downloaded(server, tmp_path, refused, monkeypatch):
    assert "2011_09_26_drive_9999_sync.zip: not there (HTTP 404)" in refused(run, server, tmp_path, DRIVE, "2011_09_26_drive_9999")
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=1000))
    assert "0.2 MB missing; free some" in refused(run, server, tmp_path, DRIVE)
    assert server.sent == [] and files(tmp_path) == []


def test_odometry_is_laid_out_as_odometry_root_and_depth_below_its_own_folder(server, tmp_path, monkeypatch):
    server.files["data_odometry_poses.zip"] = zip_of({"dataset/poses/09.txt": b"1"})
    server.files["data_odometry_calib.zip"] = zip_of({"dataset/sequences/09/calib.txt": b"P2: 1"})
    images = {f"dataset/sequences/09/image_{camera}/000000.png": b"image" for camera in (2, 3)}
    server.files["data_odometry_color.zip"] = zip_of(images)
    depth = zip_of({f"val/{DRIVE}/proj_depth/groundtruth/image_02/0000000005.png": b"depth"})
    server.files["data_depth_annotated.zip"] = depth
    checked = sources.IMPROVED_DEPTH._replace(digest=f"md5:{hashlib.md5(depth).hexdigest()}")
    monkeypatch.setattr(sources, "IMPROVED_DEPTH", checked)
    run(server, tmp_path, "--odometry", "--improved-depth", "--cameras", "image_02")
    assert [name for name in files(tmp_path) if "complete" not in name] == [
        f"depth_annotated/val/{DRIVE}/proj_depth/groundtruth/image_02/0000000005.png",
        "odometry/poses/09.txt",
        "odometry/sequences/09/calib.txt",
        "odometry/sequences/09/image_2/000000.png",
    ]


def test_lists_only(server, lists, tmp_path):
    for _ in range(2):
        run(server, tmp_path, "--lists-only")
        assert files(tmp_path) == [f"lists/{name}.txt" for name in sorted(sources.LISTS)]
    assert len(server.requests) == len(sources.LISTS)


@pytest.mark.parametrize("names", ["test_list: eigen_test", "test_list: sample_test", "test_list: own.txt", "train_list: eigen_zhou"])
def test_a_profile_fetches_its_drives_and_those_of_its_lists(server, lists, tmp_path, monkeypatch, names):
    monkeypatch.chdir(tmp_path)
    Path("own.txt").write_bytes(EIGEN)
    drives = "" if "train_list" in names else f"train_drives: [{DAY}/{DRIVE}], "
    Path("mine.yaml").write_text(f"about: a test\ndata: {{source: kitti, {drives}{names}}}\n")
    run(server, tmp_path / "kitti", "--profile", "mine.yaml", "--cameras", "image_02")
    assert sorted(path.parent.name[-9:-5] for path in (tmp_path / "kitti").rglob(".complete.json")) == ["0013", "0052", "0095"]


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (["--profile", "nothing"], "profile 'nothing' not found"),
        (["--profile", "tiny"], "profile tiny makes its own data"),
        (["--lists-only"], "eigen/test_files.txt: not there (HTTP 404)"),
    ],
)
def test_mistakes_end_in_one_line(server, tmp_path, refused, arguments, expected):
    assert expected in refused(run, server, tmp_path, *arguments)
    assert files(tmp_path) == []


def test_a_root_that_cannot_be_a_folder_and_nothing_to_download_are_told(server, tmp_path, refused):
    (tmp_path / "file").touch()
    assert "kitti: nothing can be written there" in refused(run, server, tmp_path / "file" / "kitti", DRIVE)
    with pytest.raises(SystemExit, match="2"):
        run(server, tmp_path)
