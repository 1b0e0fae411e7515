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
    """Takes frames (H, W, 3) uint8 RGB of one size; see `video_writer`."""

    def __init__(self, path: Path, rate: float) -> None:
        self.path, self.rate, self.count, self._file = path, rate, 0, None

    def write(self, frame: np.ndarray) -> None:
        """Append a frame; odd sizes, which the codec has not, get their last row or column twice.

        Raises:
            OSError: the codec is not there.
        """
        if frame.shape[1] > WIDEST:
            size = (WIDEST, max(2, round(frame.shape[0] * WIDEST / frame.shape[1])))
            frame = cv2.resize(frame, size, interpolation=cv2.INTER_AREA)
        height, width = frame.shape[:2]
        frame = cv2.copyMakeBorder(frame, 0, height % 2, 0, width % 2, cv2.BORDER_REPLICATE)
        if self._file is None:
            self.size = frame.shape[1::-1]
            self._file = cv2.VideoWriter(str(self.path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*CODEC), self.rate, self.size)
            if not self._file.isOpened():
                raise OSError(f"OpenCV cannot write {CODEC} video of {self.size[0]}×{self.size[1]}")
        if frame.shape[1::-1] != self.size:  # the bar's words may be wider than those of the first frame
            frame = _fit(frame, self.size)
        self._file.write(np.ascontiguousarray(frame[..., ::-1]))
        self.count += 1

    def release(self) -> None:
        """Let go of the file, however it is."""
        if self._file is not None:
            self._file.release()

    def close(self) -> None:
        """End the file; the codec tells of no full disk, so its frames are counted.

        Raises:
            OSError: not all were written.
        """
        self.release()
        capture = cv2.VideoCapture(str(self.path), cv2.CAP_FFMPEG)
        written = int(capture.get(cv2.CAP_PROP_FRAME_COUNT))
        capture.release()
        if written != self.count:
            raise OSError(f"{written} of {self.count} frames were written; is the disk full?")


@contextlib.contextmanager
def video_writer(path: Path, rate: float) -> Iterator[Writer]:
    """A writer whose file is whole or absent."""
    with atomic_path(path) as partial:
        writer = Writer(partial, rate)
        try:
            yield writer
        except BaseException:
            writer.release()
            raise
        writer.close()


def _fit(frame: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """A frame cut or filled at its right and lower edges to `size` (width, height)."""
    frame = frame[: size[1], : size[0]]
    return cv2.copyMakeBorder(frame, 0, size[1] - frame.shape[0], 0, size[0] - frame.shape[1], cv2.BORDER_REPLICATE)
