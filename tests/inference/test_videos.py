"""Videos frame by frame, of odd sizes, cut short, and what is no video."""

import cv2
import numpy as np
import pytest
from small_kitti import wall

from dualdepth.errors import InputError
from dualdepth.inference.videos import WIDEST, Video, video_writer


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
    assert (video.announced, video.rate, len(read)) == (12, 10.0, 12)
    for found, frame in zip(read, frames):
        assert np.abs(found.astype(int) - frame).mean() < 8
    assert video.missing(12) is None


@pytest.mark.parametrize("size", [(91, 161), (120, 320), (90, 161)])
def test_what_is_written_can_be_read_again_whatever_its_size(tmp_path, size):
    path = tmp_path / "o.mp4"
    sent = [cv2.GaussianBlur(wall(*size, seed=i), (15, 15), 5) for i in range(5)]
    with video_writer(path, 29.97) as writer:
        for frame in sent:
            writer.write(frame)
    video = Video(path)
    read = list(video.frames())
    assert len(read) == 5
    assert video.rate == pytest.approx(29.97, rel=1e-3)
    assert read[0].shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
    assert np.abs(read[0][: size[0], : size[1]].astype(int) - sent[0]).mean() < 12


def test_frames_too_wide_for_players_are_shrunk(tmp_path):
    with video_writer(tmp_path / "o.mp4", 10) as writer:
        writer.write(np.zeros((100, 2 * WIDEST, 3), np.uint8))
    assert next(Video(tmp_path / "o.mp4").frames()).shape == (50, WIDEST, 3)


def test_a_writer_that_is_stopped_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), video_writer(tmp_path / "o.mp4", 10) as writer:
        writer.write(np.zeros((90, 160, 3), np.uint8))
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())


def test_a_video_that_ends_early_is_read_as_far_as_it_goes_and_said(clip, tmp_path):
    cut = tmp_path / "cut.avi"
    cut.write_bytes(clip.read_bytes()[: clip.stat().st_size // 2])
    video = Video(cut)
    count = sum(1 for _ in video.frames())
    assert 2 < count < 10
    assert video.missing(count) == f"ends early: {count} of 12 announced frames could be read, and its results hold those"


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
