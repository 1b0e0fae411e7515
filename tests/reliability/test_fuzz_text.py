"""No text makes a reader of text do anything but give a value or refuse with one line."""

import json
from pathlib import Path

import numpy as np
import pytest
import yaml
from hypothesis import strategies as st
from strategies import bytes_of, fuzz, read_or_refuse, values_of

from data_scripts import sources
from data_scripts.own.camera import camera_of_file
from dualdepth.commands.reproduce import parse_parameters
from dualdepth.data import kitti
from dualdepth.data.lidar import map_size, velodyne_projection
from dualdepth.data.odometry import frame_files, pair_frames, read_trajectory, sequence_intrinsics
from dualdepth.data.triplets import drive_triplets
from dualdepth.evaluation.leaks import check_leak
from dualdepth.evaluation.odometry import trajectory_errors
from dualdepth.profile import load_profile
from dualdepth.run import parse_seeds
from dualdepth.training.weights import load_card

pytestmark = [pytest.mark.fuzz, pytest.mark.slow]

DAY, DRIVE = "2011_09_26", "2011_09_26/2011_09_26_drive_0001_sync"
NUMBERS = "2.2e+02 0 104 0 0 220 104 0 0 0 1 0"
CAMERAS = f"calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 8 6\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {NUMBERS}\n".encode()
LASER = b"R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.27\n"
LIST = f"{DRIVE} 0000000007 l\n{DRIVE} 0000000003 r\n{DRIVE} 12\n".encode()
POSES = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 {k}e-1\n" for k in range(6)).encode()
NUMBERED = "".join(f"{k} 1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in (0, 1, 2, 5, 6)).encode()
OWN = b'{"camera": {"fx": 220, "fy": 220, "cx": 104, "cy": 104, "width": 256, "height": 216, "distortion": []}, "made_from": "0"}'


def calibration(folder: Path, name: str) -> None:
    """The other calibration file of the day is a good one."""
    day = folder / DAY
    day.mkdir(exist_ok=True)
    (day / "calib_cam_to_cam.txt").write_bytes(CAMERAS)
    (day / "calib_velo_to_cam.txt").write_bytes(LASER)
    (folder / "damaged").replace(day / name)


def laser_calibration(folder: Path, name: str) -> None:
    calibration(folder, name)
    velodyne_projection(folder, DAY)
    height, width = map_size(folder, kitti.Frame(DRIVE, 0))
    np.zeros((height, width))


def odometry_calibration(folder: Path, name: str) -> None:
    (folder / "sequences/00").mkdir(parents=True, exist_ok=True)
    (folder / "damaged").replace(folder / "sequences/00" / name)
    sequence_intrinsics(folder, "00:image_0")


def trajectory(folder: Path) -> None:
    whole = folder / "whole.txt"
    whole.write_bytes(POSES)
    prediction, truth = read_trajectory(folder / "damaged"), read_trajectory(whole)
    pair_frames(prediction, truth)
    trajectory_errors(truth, prediction, "7dof")


TEXTS = {
    "frame list": (LIST, lambda f: kitti.read_frame_list(f / "damaged")),
    "static frames": (b"2011_09_26 2011_09_26_drive_0001_sync 0000000005\n" * 2, lambda f: kitti.read_static_frames(f / "damaged")),
    "test scenes": (b"2011_09_26_drive_0001\n2011_09_28_drive_0002\n", lambda f: kitti.read_test_scenes(f / "damaged")),
    "calib_cam_to_cam": (CAMERAS, lambda f: laser_calibration(f, "calib_cam_to_cam.txt")),
    "calib_velo_to_cam": (LASER, lambda f: laser_calibration(f, "calib_velo_to_cam.txt")),
    "odometry calib": (f"P0: {NUMBERS}\nP1: {NUMBERS}\n".encode(), lambda f: odometry_calibration(f, "calib.txt")),
    "odometry calib of two rows": (f"{NUMBERS}\n{NUMBERS}\n".encode(), lambda f: odometry_calibration(f, "calib_p0_p1.txt")),
    "poses": (POSES, trajectory),
    "numbered poses": (NUMBERED, trajectory),
    "profile as text": (
        (Path(kitti.__file__).parents[1] / "profiles/tiny.yaml").read_bytes(),
        lambda f: load_profile(str((f / "damaged").rename(f / "own.yaml"))),
    ),
    "own camera's intrinsics": (OWN, lambda f: camera_of_file((f / "damaged").rename(f / "own.json"), (216, 256))),
    "own camera's KITTI calibration": (
        CAMERAS.replace(b"S_rect_02: 8 6", b"S_rect_02: 256 216"),
        lambda f: camera_of_file((f / "damaged").rename(f / "calib.txt"), (216, 256)),
    ),
    "card as text": (b'{"network": "lr", "drives": ["a"], "sha256": "0"}', lambda f: load_card((f / "damaged").rename(f / "w.json"))),
}


@pytest.mark.parametrize("parser", TEXTS)
def test_damaged_text(parser, tmp_path, counted):
    whole, read = TEXTS[parser]

    def write_and_read(content):
        (tmp_path / "damaged").write_bytes(content)
        read(tmp_path)

    write_and_read(whole)  # what is not damaged is read
    fuzz(counted, write_and_read, bytes_of(whole, words=True))


def profile(folder: Path, value) -> None:
    (folder / "own.yaml").write_text(yaml.safe_dump(value, allow_unicode=True))
    load_profile(str(folder / "own.yaml"))


def card(folder: Path, value) -> None:
    (folder / "w.json").write_text(json.dumps(value))
    check_leak(load_card(folder / "w.safetensors"), ["a", DRIVE], allow=True)


VALUES = {
    "profile": (yaml.safe_load((Path(kitti.__file__).parents[1] / "profiles/paper.yaml").read_text()), profile),
    "profile with variants": (
        {
            "about": "a test",
            "data": {"source": "kitti", "train_drives": [DRIVE]},
            "train": {"lr": {"training.lr.max_steps": 1}, "mine": None},
            "variants": {"mine": {"label": "m", "about": "m", "network": "dual", "starts_from": "lr", "set": {"training.hr.max_steps": 6}}},
        },
        profile,
    ),
    "card": ({"network": "lr", "encoder": "resnet18", "drives": ["a"], "hr_size": [192, 192], "sha256": "0"}, card),
}


@pytest.mark.parametrize("parser", VALUES)
def test_damaged_values(parser, tmp_path, counted):
    whole, read = VALUES[parser]
    read(tmp_path, whole)
    fuzz(counted, lambda value: read(tmp_path, value), values_of(whole))


ODD = st.text(max_size=12) | st.from_regex(r"-{0,3}[0-9²٣,_ ]{1,6}") | st.just("9" * 5000)
FILE_NAMES = st.lists(st.sampled_from(["0000000001", "²", "٣", "1.5", "-1", "ñ ö", "", "9" * 200, "1"]), max_size=4)


@pytest.mark.parametrize("parse", [parse_seeds, lambda text: sources.drive_archives([text]), lambda text: parse_parameters([text])])
def test_odd_words_of_the_command_line(parse, counted):
    fuzz(counted, parse, ODD | ODD.map(lambda text: f"seed={text}"))


def test_odd_names_of_files_in_a_folder_of_frames(tmp_path_factory, counted):
    def write_and_read(stems, suffix):
        root = tmp_path_factory.mktemp("root")
        for folder in (root / DRIVE / "image_02/data", root / "sequences/00/image_2"):
            folder.mkdir(parents=True)
            for stem in stems:
                (folder / f"{stem}{suffix}").touch()
        read_or_refuse(drive_triplets, root, [DRIVE])
        read_or_refuse(frame_files, root, "00")

    fuzz(counted, write_and_read, FILE_NAMES, st.sampled_from([".png", ".jpg", ".txt"]))
