"""The manifest of public addresses, and the field's lists."""

import shutil

import pytest

from data_scripts import sources
from data_scripts.sources import LISTS, drive_archives, named_list, profile_drives, profile_lists
from dualdepth.data.kitti import read_frame_list, read_static_frames, read_test_scenes
from dualdepth.errors import InputError
from dualdepth.profile import load_profile


def test_each_days_calibration_comes_once_before_its_drives():
    archives = drive_archives(["2011_10_03_drive_0034", "2011_09_26/2011_09_26_drive_0013_sync", "2011_09_26_drive_0013_sync"])
    assert [archive.address for archive in archives] == [
        "raw_data/2011_09_26_calib.zip",
        "raw_data/2011_09_26_drive_0013/2011_09_26_drive_0013_sync.zip",
        "raw_data/2011_10_03_calib.zip",
        "raw_data/2011_10_03_drive_0034/2011_10_03_drive_0034_sync.zip",
    ]


@pytest.mark.parametrize("drive", ["0095", "2011_09_27_drive_0001", "2011_09_26/2011_09_28_drive_0001_sync", "../2011_09_26_drive_0001"])
def test_a_misspelt_drive_is_told(drive):
    with pytest.raises(InputError, match="expected a name like"):
        drive_archives([drive])


def test_an_unknown_list_names_the_known_ones(tmp_path):
    with pytest.raises(InputError, match=r"choose one of eigen_test, .*sample_test"):
        named_list("eigen", tmp_path)


@pytest.fixture
def cached_lists(real, tmp_path):
    for name, entry in LISTS.items():
        origin, home = ("sfmlearner", sources.SFMLEARNER) if sources.SFMLEARNER in entry.path else ("monodepth2", sources.SPLITS)
        shutil.copy(real("splits") / origin / entry.path.removeprefix(f"{home}/"), tmp_path / f"{name}.txt")
    return tmp_path


def test_the_lists_are_unchanged_and_hold_what_the_field_says(cached_lists):
    paths = {name: named_list(name, cached_lists, "https://127.0.0.1:1/") for name in LISTS}  # checked by their sha256
    expected = {"eigen_test": 697, "eigen_zhou_train": 39810, "eigen_zhou_val": 4424, "eigen_improved": 652}
    assert {name: len(read_frame_list(paths[name])) for name in expected} == expected
    assert len(read_static_frames(paths["static_frames"])) == 8044 and len(read_test_scenes(paths["test_scenes"])) == 28
    every = read_frame_list(paths["eigen_test"])
    sample = [f for f in every if f.drive[-9:-5] in ("0052", "0013") and f.date == "2011_09_26"]
    assert read_frame_list(named_list("sample_test", cached_lists)) == sample


def test_the_papers_drives_are_those_of_both_its_lists(cached_lists):
    data = load_profile("paper").data
    drives = profile_drives(data, profile_lists(data, cached_lists))
    validated = {frame.drive for frame in read_frame_list(named_list("eigen_zhou_val", cached_lists))}
    assert len(drives) == 60 and validated < set(drives)  # 32 to train on, those of validation among them, and 28 to score
