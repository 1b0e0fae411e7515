"""Frames come in their order in time, from a folder or a video; what is missing is noticed, and what is none is named."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import PIL.Image
import pytest
from own_film import frame, write_frames, write_video
from small_kitti import wall

from dualdepth.data.frames import Footage, Video, is_image, media
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError


@pytest.fixture(scope="module")
def clip(tmp_path_factory):
    """MJPG in AVI, which can be read to where it is cut."""
    frames = [cv2.GaussianBlur(wall(90, 160, seed=k), (15, 15), 5) for k in range(12)]
    return write_video(tmp_path_factory.mktemp("clips") / "ein Film ü.avi", frames, "MJPG")


def test_frames_that_are_wanted_are_those_of_the_whole_video(clip):
    whole = dict(Video(clip).frames())
    for wanted in ({0}, {1, 4, 5}, range(0, 100, 3), {11}):
        some = dict(Video(clip).frames(wanted))
        assert list(some) == [number for number in range(12) if number in wanted]
        assert all((frame == whole[number]).all() for number, frame in some.items())


@pytest.mark.parametrize("content", [b"", b"no video", b"\0" * 5000])
def test_what_is_no_video_is_named_with_a_command_that_leaves_it_alone(tmp_path, content, capfd):
    path = tmp_path / "x y.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x y\.mp4: (empty|[ -~]+ -i '/.*/x y\.mp4' .* '/.*/x y.converted.mp4')") as error:
        Video(path)
    assert ("empty" in str(error.value)) == (not content) and capfd.readouterr() == ("", "")


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.95])
def test_damaged_videos_end_or_are_refused(clip, tmp_path, share):
    data, path = bytearray(clip.read_bytes()), tmp_path / "damaged.avi"
    place = int(share * len(data))
    data[place : place + 200] = bytes(200)
    path.write_bytes(data)
    try:
        assert sum(1 for _ in Video(path).frames()) <= 13
    except InputError as error:
        assert "damaged.avi" in str(error)


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


def test_a_file_of_another_kind_does_not_make_fractions_of_counters(tmp_path):
    names = ["f1.9.png", "f1.11.png", "poster7.png"]
    write_frames(tmp_path / "f", [frame(0)] * 3, [name[:-4] for name in names])
    assert [path.name for path in media((tmp_path / "f").iterdir(), tmp_path / "f")] == names


def test_what_a_file_is_its_bytes_say_and_of_what_is_left_out_a_folder_tells(tmp_path, capsys):
    pictures = [PIL.Image.fromarray(wall(48, 64, seed=k)) for k in range(4)]
    pictures[0].save(tmp_path / "still.gif")
    pictures[0].save(tmp_path / "photo.mov", "JPEG")
    pictures[0].save(tmp_path / "moves.gif", save_all=True, append_images=pictures[1:], duration=100)
    pictures[0].convert("1").save(tmp_path / "no times.gif", save_all=True, append_images=[p.convert("1") for p in pictures[1:]])
    (tmp_path / "raw.mjpeg").write_bytes((tmp_path / "photo.mov").read_bytes() * 3)
    codes = {".ts": "mpg2", ".m2ts": "mpg2", ".vob": "mpg2", ".flv": "FLV1", ".mkv": "MJPG", ".3gp": "mp4v", ".mp4": "mp4v"}
    films = [write_video(tmp_path / f"v{suffix}", [frame(k) for k in range(3)], code, rate=25) for suffix, code in codes.items()]
    others = {"12:30.jpg": 6} | {f"{k}.png": k for k in range(6) if k != 2}  # FFmpeg itself takes a VOB that is called so for an image
    copies = [shutil.copy(films[k], tmp_path / name) for name, k in ({"f.dat": 0, "none": 2} | others).items()]
    films += [tmp_path / "raw.mjpeg", *map(Path, copies)]
    (tmp_path / "phone.heic").write_bytes(b"\0\0\0\x1cftypheic" + bytes(100))
    with pytest.raises(InputError, match=r"phone\.heic: a HEIC .*heif-convert /.*/phone\.heic /.*/phone\..*\.jpg"):
        read_image(tmp_path / "phone.heic")
    for name in ("notes.txt", "own.json", ".hidden.png", "letter.docx", "array.npy", "text.asc"):
        (tmp_path / name).write_bytes(b"words")
    for name in ("lost.png", "lost.dat"):
        (tmp_path / name).symlink_to("nowhere")
    found = {path.name: is_image(path) for path in media(tmp_path.iterdir(), "here")}
    images = dict.fromkeys(("still.gif", "no times.gif", "photo.mov", "phone.heic", "lost.png"), True)
    assert found == images | dict.fromkeys(("moves.gif", *(film.name for film in films)), False)
    assert all(len(list(Video(path).frames())) == 3 for path in films) and len(list((gif := Video(tmp_path / "moves.gif")).frames())) == 4
    assert gif.missing is None
    (tmp_path / "moves.gif").write_bytes((tmp_path / "moves.gif").read_bytes()[:-500])
    assert "the file has no end" in gif.missing
    assert "here: 4 of 26 files are left out, since they are no images or videos (.asc, .dat, .docx, .npy)" in capsys.readouterr().err
    assert {path.name for path in media(tmp_path.iterdir(), "here", videos=False)} == {*images, *others}


def test_a_video_gives_the_frames_that_were_written(tmp_path):
    frames = [frame(k) for k in range(6)]
    footage = Footage(write_video(tmp_path / "v.mp4", frames))
    stills = list(footage.stills())
    assert [s.number for s in stills] == list(range(6)) and footage.length == 6
    for still, written in zip(stills, frames):
        assert np.abs(still.image.astype(float) - written).mean() < 6  # the codec's loss
    assert numbers(footage) == list(range(6)), "it can be gone through again"
    assert [s.number for s in footage.stills({1, 4})] == [1, 4]


def test_a_video_that_ends_early_is_refused_when_its_end_is_reached_and_a_rate_that_none_has_is_replaced(clip, tmp_path, capsys):
    data = bytearray(clip.read_bytes()[: clip.stat().st_size // 2])
    data[(at := data.index(b"strh") + 32) : at + 4] = (10**6).to_bytes(4, "little")
    (tmp_path / "cut.avi").write_bytes(data)
    assert Video(tmp_path / "cut.avi").rate == 25 and "1e+06" in capsys.readouterr().err
    with pytest.raises(InputError, match=r"cut\.avi: ends early: \d of 12 announced frames could be read"):
        list(Footage(tmp_path / "cut.avi").stills())


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
