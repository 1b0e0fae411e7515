"""Video files, read one frame at a time through OpenCV's FFmpeg."""

import math
import os
from collections.abc import Container, Iterator
from pathlib import Path

import cv2
import numpy as np

from dualdepth.errors import InputError

os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")  # else FFmpeg tells of a damaged file in its own words as well
DEFAULT_RATE = 25.0
"""Frames a second where the file does not say."""


class Video:
    """A video that is read once from its beginning; frames are turned as the file says, (H, W, 3) uint8 RGB.

    Raises:
        InputError: it cannot be opened or has no frames.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        level = cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_ERROR)  # a file that cannot be opened is this class's to tell
        self._capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
        cv2.utils.logging.setLogLevel(level)
        count, rate = self._capture.get(cv2.CAP_PROP_FRAME_COUNT), self._capture.get(cv2.CAP_PROP_FPS)
        self.announced = int(count) if 0 < count < 1e9 else None
        """Frames that the file says it has; None where it does not say."""
        self.rate = rate if math.isfinite(rate) and 0 < rate <= 1000 else DEFAULT_RATE
        """Frames a second."""
        self.passed = 0
        """Frames that were there so far."""
        there, self._first = self._capture.read()
        if not there:
            self.close()
            raise InputError(
                f"{path}: no video that can be decoded, or one without frames;"
                f" copy it again, or convert it: ffmpeg -i {self.path.name} -crf 17 video.mp4"
            )

    def frames(self, wanted: Container[int] | None = None) -> Iterator[tuple[int, np.ndarray]]:
        """Number, from 0, and picture of all frames that can be read, or of those whose numbers are wanted; others are not decoded."""
        frame = self._first
        try:
            while True:
                if wanted is None or self.passed in wanted:
                    there, frame = (True, frame) if self.passed == 0 else self._capture.retrieve()
                    if not there:
                        return
                    yield self.passed, cv2.cvtColor(frame, cv2.COLOR_BGR2RGB)
                self.passed += 1
                if not self._capture.grab():
                    return
        finally:
            self.close()

    @property
    def size(self) -> tuple[int, int]:
        """(height, width) of the first frame; files whose later frames differ are rare, but there are some."""
        return self._first.shape[:2]

    def close(self) -> None:
        """Let go of the file."""
        self._capture.release()

    @property
    def missing(self) -> str | None:
        """A word on a video that ended early, once it was read; None where all were there, or nearly so: some formats only estimate."""
        if self.announced and self.passed < self.announced - max(2, self.announced // 50):
            return f"ends early: {self.passed} of {self.announced} announced frames could be read"
        return None
