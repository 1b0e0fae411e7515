"""Exporting ground truth: what is listed, in its order, and one line for what is missing."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from data_scripts import export_depth
from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.data.kitti import Frame, read_frame_list, velodyne_path
from dualdepth.data.lidar import ground_truth

DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"


@pytest.fixture
def kitti(tmp_path, monkeypatch, kitti_factory):
    """A root with frames 0 to 3 of one drive, and a list of them in the working directory."""
    monkeypatch.chdir(tmp_path)
    root, rng = kitti_factory({DRIVE: range(4)}), np.random.default_rng(0)
    for index in range(4):
        path = velodyne_path(root, Frame(DRIVE, index))
        path.parent.mkdir(parents=True, exist_ok=True)
        (rng.uniform(-1, 1, (500, 4)) * [40, 20, 8, 1]).astype("<f4").tofile(path)
    write_list(range(4))
    return root


def write_list(indices):
    Path("list.txt").write_text("".join(f"{DRIVE} {index:010d} l\n" for index in indices))


def run(*arguments):
    return export_depth.main(["--kitti", "kitti", "--list", "list.txt", "--out", "out/G.npz", *arguments])


@pytest.mark.parametrize("camera_z", [False, True])
def test_writes_the_ground_truth_of_the_list_in_its_order(kitti, camera_z):
    write_list([2, 0, 3])
    run(*["--camera-z"] * camera_z)
    maps = load_ground_truth("out/G.npz")
    assert maps.names == ["000000", "000001", "000002"]
    for depth, frame in zip(maps, read_frame_list("list.txt")):
        expected = ground_truth("kitti", frame, camera_z=camera_z)
        assert expected.any() and depth.dtype == np.float32
        np.testing.assert_array_equal(depth, expected)


def test_missing_files_are_in_one_message_or_left_out_and_keys_keep_the_place(kitti, capsys, refused):
    write_list([0, 7, 1, 8])
    message = refused(run)
    assert "2 of 4 files are missing" in message and all(f"{DRIVE}/velodyne_points/data/{i:010d}.bin" in message for i in (7, 8))
    run("--allow-missing")
    printed = capsys.readouterr().out
    assert "0000000007.bin" in printed and "0000000008.bin" in printed and "2 depth maps" in printed
    assert load_ground_truth("out/G.npz").names == ["000000", "000002"]
    write_list([7, 8])
    assert "2 of 2" in refused(run, "--allow-missing")


def test_improved_maps_are_exported_without_the_raw_data(kitti, refused):
    folder = Path("annotated/val/2011_09_26_drive_0001_sync/proj_depth/groundtruth/image_02")
    folder.mkdir(parents=True)
    for index in (0, 1):
        cv2.imwrite(str(folder / f"{index:010d}.png"), np.full((4, 6), 256 * (index + 2), np.uint16))
    write_list([0, 1])
    export_depth.main(["--improved", "annotated", "--list", "list.txt", "--out", "out/G.npz"])
    assert [depth[0, 0] for depth in load_ground_truth("out/G.npz")] == [2, 3]
    Path("out/G.npz").unlink()
    write_list([0, 5])
    assert "drive_0001_sync/image_02/0000000005" in refused(run, "--improved", "annotated")
