"""Results say what they are, and hold the depth that was predicted."""

import math
import os
from concurrent.futures import ThreadPoolExecutor
from unittest.mock import Mock

import cv2
import numpy as np
import PIL.Image
import pytest
from small_kitti import wall

from dualdepth.data.frames import Video
from dualdepth.errors import note
from dualdepth.inference.results import SMALLEST, SUFFIXES, WIDEST, Style, colour_ends, colours_of, picture, save, write_video

STYLE = Style("Depth is relative. Learned by a 3×3 net.")


@pytest.fixture
def depth():
    return np.geomspace(1e-5, 1000, 40 * 60, dtype=np.float32).reshape(40, 60)


def test_the_png_is_kittis_and_says_so_and_the_array_is_the_depth(depth, tmp_path):
    save("npy", tmp_path / "d.npy", wall(40, 60), depth, STYLE)
    assert np.array_equal(np.load(tmp_path / "d.npy"), depth)
    save("depth", tmp_path / "d.png", wall(40, 60), depth, STYLE)
    read = cv2.imread(str(tmp_path / "d.png"), cv2.IMREAD_UNCHANGED)
    assert (read.dtype, read.shape) == (np.uint16, depth.shape)
    within = (depth > 0.01) & (depth < 255.9)
    np.testing.assert_allclose(read[within] / 256, depth[within], atol=1 / 512 + 1e-6)
    assert (read[depth > 256] == 65535).all() and read[0, 0] == 1  # 0 means none
    with PIL.Image.open(tmp_path / "d.png") as image:
        assert image.text["Description"] == f"value / 256 = relative depth; 65535 = 256 or more. {STYLE.about}"


def test_a_png_of_which_much_is_at_its_end_says_so_once_and_how_to_keep_it(depth, tmp_path, capsys):
    for far, said in ((24, 0), (25, 1), (1000, 0)):  # 1 % are allowed
        save("depth", tmp_path / "d.png", wall(40, 60), np.where(np.arange(2400).reshape(40, 60) < far, 300, depth.clip(0, 200)), STYLE)
        assert capsys.readouterr().err.count("from 256 up is cut off in PNG files; --scale 0.1 or --save npy keeps it\n") == said
    with ThreadPoolExecutor(8) as pool:
        list(pool.map(note, [f"text {i // 8}" for i in range(400)]))
    assert capsys.readouterr().err.count("\n") == 50


def read_ply(path):
    """An independent reader of binary PLY: comments, and (N, 3) points and colours."""
    head, _, body = path.read_bytes().partition(b"end_header\n")
    lines = head.decode("ascii").splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    count = int(next(line for line in lines if line.startswith("element vertex")).split()[-1])
    rows = np.frombuffer(body, np.uint8).reshape(count, 15)
    return [line for line in lines if line.startswith("comment")], rows[:, :12].copy().view("<f4"), rows[:, 12:]


def test_points_project_to_their_pixels_in_their_colours(depth, tmp_path):
    image = wall(40, 60)
    save("ply", tmp_path / "d.ply", image, depth, STYLE._replace(intrinsics=(50.0, 55.0, 30.0, 20.0)))
    comments, points, rgb = read_ply(tmp_path / "d.ply")
    assert np.array_equal(points[:, 2], depth.ravel())
    v, u = np.indices(depth.shape).reshape(2, -1)
    np.testing.assert_allclose(50 * points[:, 0] / points[:, 2] + 30, u, atol=1e-3)
    np.testing.assert_allclose(55 * points[:, 1] / points[:, 2] + 20, v, atol=1e-3)
    assert np.array_equal(rgb, image.reshape(-1, 3)) and "comment camera: fx 50.0 fy 55.0 cx 30.0 cy 20.0 as given" in comments
    assert "comment Depth is relative. Learned by a 3?3 net." in comments


def test_intrinsics_not_given_are_a_stated_default():
    fx, fy, cx, cy, _, note, _ = STYLE.camera((375, 1242))
    assert (fx, cx, cy) == (pytest.approx(721.5377, rel=1e-6), 620.5, 187.0) and fx == fy and "81.4 degrees by default" in note
    assert Style("", field_of_view=90).camera((10, 200)).fx == pytest.approx(100)
    assert Style("", focal=33).camera((10, 21))[:4] == (33, 33, 10, 4.5)


def test_near_is_bright_and_far_is_dark():
    depth = np.geomspace(1.6, 1000, 40 * 60, dtype=np.float32).reshape(40, 60)
    drawn = colours_of(depth, colour_ends(depth)).sum(2)
    assert drawn[0, 0] > 500 > 50 > drawn[-1, -1] and (np.diff(drawn.ravel().astype(int)) <= 1).all()
    flat = np.linspace(5, 5.05, 2400, dtype=np.float32).reshape(40, 60)  # constant to 1 %
    assert np.ptp(colours_of(flat, colour_ends(flat)), axis=(0, 1)).max() < 20


@pytest.mark.parametrize("size", [(1, 1), (16, 24), (375, 1242), (700, 301)])
def test_pictures_hold_the_image_whole_beside_a_bar_of_one_width_for_all_depths(size):
    depth, image = np.full(size, 3.0, np.float32), wall(*size)
    alone, both = (picture(depth, colour_ends(depth), "relative depth", left) for left in (None, image))
    assert alone.shape[0] == both.shape[0] == max(SMALLEST, size[0])
    assert both.shape[1] - alone.shape[1] == size[1]
    assert alone.shape[1] > size[1] + 20
    assert np.array_equal(both[: size[0], : size[1]], image)
    assert np.array_equal(both[:, size[1] :], alone)
    far = depth * np.float32(1.2345e6)
    assert picture(far, colour_ends(far), "relative depth").shape == alone.shape


@pytest.mark.parametrize("kind", SUFFIXES)
def test_nothing_half_written_is_left(kind, tmp_path, depth, monkeypatch):
    monkeypatch.setattr("os.replace", Mock(side_effect=OSError("no space")))
    with pytest.raises(OSError, match="no space"):
        save(kind, tmp_path / f"d{SUFFIXES[kind]}", wall(40, 60), depth, STYLE)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("rate", [29.97, 105611 / 500, 655.37, 1 / 30, 0.0013, 5e3])
def test_a_video_that_is_written_can_be_read_again_whatever_its_size_name_and_rate(tmp_path, rate):
    size = (91, 161) if rate == 29.97 else (90, 160)
    path = tmp_path / os.fsdecode(b"\xff.mp4")
    sent = [cv2.GaussianBlur(wall(*size, seed=i), (15, 15), 5) for i in range(5)]
    write_video(path, rate, sent)
    video = Video(path)
    read = [frame for _, frame in video.frames()]
    assert len(read) == 5 * math.ceil(0.1 / rate)
    assert len(read) / video.rate == pytest.approx(5 / rate, rel=1e-4 if rate > 1 else 0.005)
    assert read[0].shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
    assert np.abs(read[0][: size[0], : size[1]].astype(int) - sent[0]).mean() < 12


def test_frames_too_wide_for_players_are_shrunk_and_a_video_that_is_stopped_leaves_no_file(tmp_path):
    wide = np.zeros((100, 2 * WIDEST, 3), np.uint8)
    for image in (wide, wide.transpose(1, 0, 2)):
        write_video(tmp_path / "o.mp4", 10, [image])
        assert sorted(next(Video(tmp_path / "o.mp4").frames())[1].shape) == [3, 50, WIDEST]

    def stopped():
        yield wide
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_video(tmp_path / "stopped.mp4", 10, stopped())
    assert [path.name for path in tmp_path.iterdir()] == ["o.mp4"]
