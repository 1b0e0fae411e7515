"""Videos are written frame by frame, of any size, whole or not at all."""

import cv2
import numpy as np
import pytest
from small_kitti import wall

from dualdepth.data.frames import Video
from dualdepth.inference.videos import WIDEST, video_writer


@pytest.mark.parametrize("size", [(91, 161), (120, 320), (90, 161)])
def test_what_is_written_can_be_read_again_whatever_its_size(tmp_path, size):
    path = tmp_path / "o.mp4"
    sent = [cv2.GaussianBlur(wall(*size, seed=i), (15, 15), 5) for i in range(5)]
    with video_writer(path, 29.97) as writer:
        for frame in sent:
            writer.write(frame)
    video = Video(path)
    read = [frame for _, frame in video.frames()]
    assert len(read) == 5
    assert video.rate == pytest.approx(29.97, rel=1e-3)
    assert read[0].shape == (size[0] + size[0] % 2, size[1] + size[1] % 2, 3)
    assert np.abs(read[0][: size[0], : size[1]].astype(int) - sent[0]).mean() < 12


def test_frames_too_wide_for_players_are_shrunk(tmp_path):
    with video_writer(tmp_path / "o.mp4", 10) as writer:
        writer.write(np.zeros((100, 2 * WIDEST, 3), np.uint8))
    assert next(Video(tmp_path / "o.mp4").frames())[1].shape == (50, WIDEST, 3)


def test_a_writer_that_is_stopped_leaves_nothing(tmp_path):
    with pytest.raises(KeyboardInterrupt), video_writer(tmp_path / "o.mp4", 10) as writer:
        writer.write(np.zeros((90, 160, 3), np.uint8))
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
