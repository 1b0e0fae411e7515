"""Frames come in their order in time, from a folder or a video; what is missing is noticed, and what is none is named."""

import shutil
from pathlib import Path

import cv2
import PIL.Image
import pytest
from own_film import frame, write_frames, write_video
from small_kitti import wall

from dualdepth.data.frames import Video, is_image, media
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


def test_a_video_that_ends_early_says_so_and_a_rate_that_none_has_is_replaced(clip, tmp_path, capsys):
    data = bytearray(clip.read_bytes()[: clip.stat().st_size // 2])
    data[(at := data.index(b"strh") + 32) : at + 4] = (10**6).to_bytes(4, "little")
    (tmp_path / "cut.avi").write_bytes(data)
    video = Video(tmp_path / "cut.avi")
    assert video.rate == 25 and "1e+06" in capsys.readouterr().err
    found = len(list(video.frames()))
    assert 0 < found < 12 and video.missing == f"ends early: {found} of 12 announced frames could be read"
