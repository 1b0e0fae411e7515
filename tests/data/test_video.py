"""Videos are read frame by frame, also when they are cut short, and what is no video is named."""

import cv2
import numpy as np
import pytest
from small_kitti import wall

from dualdepth.data.frames import Video
from dualdepth.errors import InputError


@pytest.fixture(scope="module")
def frames():
    return [cv2.GaussianBlur(wall(90, 160, seed=i), (15, 15), 5) for i in range(12)]


@pytest.fixture(scope="module")
def clip(frames, tmp_path_factory):
    """MJPG in AVI, which can be read to where it is cut."""
    path = tmp_path_factory.mktemp("clips") / "ein Film ü.avi"
    file = cv2.VideoWriter(str(path), cv2.VideoWriter_fourcc(*"MJPG"), 10, (160, 90))
    for frame in frames:
        file.write(frame[..., ::-1])
    file.release()
    return path


def test_all_frames_come_in_order_and_in_rgb(clip, frames):
    video = Video(clip)
    read = list(video.frames())
    assert (video.announced, video.rate, video.size, [number for number, _ in read]) == (12, 10.0, (90, 160), list(range(12)))
    for (_, found), frame in zip(read, frames):
        assert np.abs(found.astype(int) - frame).mean() < 8
    assert video.missing is None


def test_frames_that_are_wanted_are_those_of_the_whole_video(clip):
    whole = dict(Video(clip).frames())
    for wanted in ({0}, {1, 4, 5}, range(0, 100, 3), {11}):
        some = dict(Video(clip).frames(wanted))
        assert list(some) == [number for number in range(12) if number in wanted]
        assert all((frame == whole[number]).all() for number, frame in some.items())


def test_a_video_that_ends_early_is_read_as_far_as_it_goes_and_said(clip, tmp_path):
    cut = tmp_path / "cut.avi"
    cut.write_bytes(clip.read_bytes()[: clip.stat().st_size // 2])
    video = Video(cut)
    count = sum(1 for _ in video.frames())
    assert 2 < count < 10
    assert video.missing == f"ends early: {count} of 12 announced frames could be read"


@pytest.mark.parametrize("content", [b"", b"no video", b"\0" * 5000])
def test_what_is_no_video_is_named(tmp_path, content, capfd):
    path = tmp_path / "x.mp4"
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"x\.mp4: no video that can be decoded, or one without frames"):
        Video(path)
    assert capfd.readouterr() == ("", "")


def test_a_missing_video_is_named(tmp_path):
    with pytest.raises(InputError, match="gone"):
        Video(tmp_path / "gone.mp4")


@pytest.mark.parametrize("share", [0.05, 0.3, 0.6, 0.95])
def test_damaged_videos_end_or_are_refused(clip, tmp_path, share):
    data = bytearray(clip.read_bytes())
    place = int(share * len(data))
    data[place : place + 200] = bytes(200)
    path = tmp_path / "damaged.avi"
    path.write_bytes(data)
    try:
        assert sum(1 for _ in Video(path).frames()) <= 13
    except InputError as error:
        assert "damaged.avi" in str(error)
