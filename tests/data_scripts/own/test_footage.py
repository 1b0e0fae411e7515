"""Frames come in their order in time, from a folder or a video, and what is no footage is named."""

import shutil

import numpy as np
import pytest
from own_film import frame, write_frames, write_video

from data_scripts.own.footage import Footage
from dualdepth.errors import InputError


def numbers(footage):
    return [still.number for still in footage.stills()]


ORDERS = {"f1, f2, f3, f6, f7": [0, 1, 2, 5, 6], "cam2_8, cam2_9, cam2_10, cam2_12": [0, 1, 2, 4], "f10, f20, f30, f50": [0, 1, 2, 4]}
ORDERS |= {"a, b, c": [0, 1, 2], "name, name (1), name (2), name (10)": [0, 1, 2, 10], "-12, -11, -2, -1": [0, 1, 10, 11]}
ORDERS |= {"1305031102.875304, 1305031102.975211, 1305031103.075309, 1305031103.375300": [0, 1, 2, 5], "7.9, 7.95, 8, 8.05": [0, 1, 2, 3]}
ORDERS |= {"1305031102.1753, 1305031103": [0, 1], "1305031102.25, 1305031102.5, 1305031103": [0, 1, 2]}
ORDERS |= {"1.75, 2.5, 3.25": [0, 1, 2], "cam2.8, cam2.9, cam2.10, cam2.12": [0, 1, 2, 4], "0, 50, 100, 150, 250": [0, 1, 2, 3, 5]}
ORDERS |= {"20261130125859750, 20261130125900000, 20261130125900250, 20261130125900750": [0, 1, 2, 4]}  # a clock's
ORDERS |= {"0057, 0058, 0059, 0100": [0, 1, 2, 43], "930000, 940000, 950000, 1000000": [0, 1, 2, 7]}
ORDERS |= {"I_20261130_125958, I_20261130_125959, I_20261130_130000, I_20261130_130002": [0, 1, 2, 4]}
ORDERS |= {"12.5000, 12.900000000, 13.100000, 13.990000000": [0, 1, 2, 3], "8.250_cam0, 8.500_cam0, 8.750_cam0, 9.250_cam0": [0, 1, 2, 4]}
ORDERS |= {"2024-01-02 10-15-59-900, 2024-01-02 10-16-00-100, 2024-01-02 10-16-00-300": [0, 1, 2]}
ORDERS |= {"IMG_9997, IMG_9998, IMG_9999, IMG_0001, IMG_0002, IMG_0004": [0, 1, 2, 3, 4, 6]}
ORDERS |= {", ".join(str(1403636579763555584 + k) for k in (0, 50_000_896, 100_000_000, 149_999_616, 400_000_000)): [0, 1, 2, 3, 8]}


@pytest.mark.parametrize(("listed", "expected"), ORDERS.items())
def test_names_say_which_frames_are_neighbours_and_natural_order_is_that_of_time(tmp_path, listed, expected, capsys):
    names = listed.split(", ")
    footage = Footage(write_frames(tmp_path / "f", [frame(0)] * len(names), names[::-1]))
    assert numbers(footage) == expected and footage.length == len(names) and [still.file.stem for still in footage.stills()] == names
    unsure = names[0] in ("a", "2024-01-02 10-15-59-900", "IMG_9997", "12.5000", "1.75", "1305031102.25")
    assert sum("order" in line or "roll over" in line for line in capsys.readouterr().err.splitlines()) == unsure


def test_a_video_gives_the_frames_that_were_written(tmp_path):
    frames = [frame(k) for k in range(6)]
    footage = Footage(write_video(tmp_path / "v.mp4", frames))
    stills = list(footage.stills())
    assert [s.number for s in stills] == list(range(6)) and footage.length == 6
    for still, written in zip(stills, frames):
        assert np.abs(still.image.astype(float) - written).mean() < 6  # the codec's loss
    assert numbers(footage) == list(range(6)), "it can be gone through again"
    assert [s.number for s in footage.stills({1, 4})] == [1, 4]


def test_a_video_that_ends_early_is_refused_when_its_end_is_reached(tmp_path):
    video = write_video(tmp_path / "cut.avi", [frame(k) for k in range(12)], "MJPG")
    video.write_bytes(video.read_bytes()[: video.stat().st_size // 2])
    with pytest.raises(InputError, match=r"cut\.avi: ends early: \d of 12 announced frames could be read"):
        list(Footage(video).stills())


def test_the_digest_follows_the_bytes_and_a_frame_of_another_size_is_named(tmp_path):
    folder = write_frames(tmp_path / "f", [frame(0), frame(1)])
    before = Footage(folder).digest()
    shutil.copyfile(folder / "000001.png", folder / "000001.tif")  # in two formats
    assert Footage(folder).digest() == before
    write_frames(folder, [frame(0), frame(1.5), frame(2, size=(100, 120))])
    assert Footage(folder).digest() != before
    with pytest.raises(InputError, match=r"000002\.png: frame 2 has 120×100 pixels, the first one 256×216"):
        list(Footage(folder).stills())


@pytest.mark.parametrize("name", ["nothing", "empty", "photo.png"])
def test_what_is_no_footage_is_named_with_what_to_do(tmp_path, name):
    (tmp_path / "empty").mkdir()
    (tmp_path / "photo.png").touch()
    with pytest.raises(InputError, match=f"{name}: .*; give"):
        Footage(tmp_path / name)
