"""A data set of an own camera gets a size and a profile that fit it."""

import pytest
import yaml

from data_scripts.own.dataset import fitting_size, profile_text, read_record
from dualdepth.errors import InputError
from dualdepth.profile import Profile, load_profile

PAPER = {(375, 1242): (384, 1248), (370, 1226): (384, 1248)}  # KITTI's frames and the size in the paper
OTHERS = {(1080, 1920): (480, 864), (720, 1280): (480, 864), (480, 640): (480, 672), (1920, 1080): (864, 480), (200, 200): (192, 192)}


@pytest.mark.parametrize(("frames", "expected"), (PAPER | OTHERS).items())
def test_the_size_is_the_largest_of_nearly_the_frames_shape(frames, expected):
    assert fitting_size(frames) == expected


def test_frames_too_small_are_refused():
    with pytest.raises(InputError, match="320×120 pixels are too small"):
        fitting_size((120, 320))


@pytest.mark.parametrize("size", [(384, 672), (192, 192)])
@pytest.mark.parametrize("triplets", [5, 41, 236, 20000])
def test_the_written_profile_is_valid_and_asks_for_as_many_steps_as_sample(triplets, size, tmp_path):
    (tmp_path / "own.yaml").write_text(profile_text(size, triplets))
    profile = load_profile(str(tmp_path / "own.yaml"))
    assert profile.data.source == "own" and profile.data.hr_size == size and not profile.data.has_truth
    epochs = profile.training.lr.epochs
    assert epochs == max(1, min(40, round(4800 / triplets))) and profile.training.hr.epochs <= epochs
    assert {**yaml.safe_load(profile_text((480, 864), 1)), "name": "own"}["about"] == load_profile("own").about


def test_the_frames_of_an_own_camera_are_named_by_its_data_set():
    profile = load_profile("own").model_dump()
    with pytest.raises(ValueError, match="not for source: own"):
        Profile.model_validate(profile | {"data": profile["data"] | {"train_drives": ["2000_01_01/x"]}})


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"camera": {"width": 0, "height": 5}, "made_from": "a"}', '{"camera": 3}'])
def test_a_record_that_is_none_is_refused(tmp_path, text):
    assert read_record(tmp_path) is None
    (tmp_path / "own.json").write_text(text)
    with pytest.raises(InputError, match=r"own\.json: .*own_camera\.py"):
        read_record(tmp_path)
