"""Videos, written one frame at a time through OpenCV's FFmpeg."""

import contextlib
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from dualdepth.files import atomic_path

CODEC = "mp4v"
"""MPEG-4 in MP4, which every OpenCV wheel writes."""
WIDEST = 3840
"""Pixels; wider side-by-side frames are shrunk, since players refuse them."""


class Writer:
    """Takes frames (H, W, 3) uint8 RGB; see `video_writer`. The first one's size, made even, is the video's."""

    def __init__(self, path: Path, rate: float) -> None:
        self.path, self.rate, self.count, self.file = path, rate, 0, cv2.VideoWriter()

    def write(self, frame: np.ndarray) -> None:
        """Append a frame; odd sizes, which the codec has not, get their last row or column twice.

        Raises:
            OSError: the codec is not there.
        """
        if frame.shape[1] > WIDEST:
            size = (WIDEST, max(2, round(frame.shape[0] * WIDEST / frame.shape[1])))
            frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
        if self.count == 0:
            height, width = self.size = tuple(side + side % 2 for side in frame.shape[:2])
            if not self.file.open(str(self.path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*CODEC), self.rate, (width, height)):
                raise OSError(f"OpenCV cannot write {CODEC} video of {width}×{height}")
        frame = frame[: self.size[0], : self.size[1]]  # the bar's words may be wider than those of the first frame, or narrower
        missing = np.subtract(self.size, frame.shape[:2])
        frame = cv2.copyMakeBorder(frame, 0, missing[0], 0, missing[1], cv2.BORDER_REPLICATE)
        self.file.write(np.ascontiguousarray(frame[..., ::-1]))
        self.count += 1


@contextlib.contextmanager
def video_writer(path: Path, rate: float) -> Iterator[Writer]:
    """A writer whose file, of `rate` frames a second, is whole or absent.

    Raises:
        OSError: not all frames were written; the codec tells of no full disk, so they are counted.
    """
    with atomic_path(path) as partial:
        writer = Writer(partial, rate)
        try:
            yield writer
        finally:
            writer.file.release()
        capture = cv2.VideoCapture(str(partial), cv2.CAP_FFMPEG)
        written = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        if written != writer.count:
            raise OSError(f"{written} of {writer.count} frames were written; is the disk full?")
