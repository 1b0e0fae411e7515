"""How two frames of a film differ: do they show the same place, how far did the picture move, did the camera travel or only turn?

Optical flow on small copies (T. Kroeger et al., "Fast Optical Flow using Dense Inverse Search", ECCV 2016, by OpenCV). The bounds were
set on KITTI at 10 Hz: drive 0095 and another in grey, sequences 02 and 06.
"""

from typing import NamedTuple

import cv2
import numpy as np

WIDTH = 256
"""Pixels of the small copies."""
STATIC = 0.001
"""Flow, as a share of the width, below which the camera stands still: a quarter of a small pixel. Noise alone gives 0.0002."""
USEFUL = (0.004, 0.03)
"""Median flow that a data set may have. KITTI's drives have 0.008 to 0.013, with 0.004 and 0.03 as their slowest and fastest pairs."""
AIM = 0.012
"""Median flow that a stride is chosen for: KITTI's at 10 Hz."""
SAME_PLACE = 0.3
"""Share of pixels whose flow forth and back agrees, below which two frames are no neighbours: KITTI's have at least 0.5, frames that do
not belong together at most 0.27."""
CLOSE = 0.45
"""The same of a data set's median pair, at least: KITTI has 0.8, every second frame of it 0.6, every fourth 0.35 to 0.43."""
TRAVELS = 0.15
"""Share of the median flow that no turn of the camera explains, at least: KITTI has 0.8, a camera that only turns 0.04."""


class Motion(NamedTuple):
    """From one frame to another."""

    flow: float
    """Median length of the flow, as a share of the width."""
    agrees: float
    """Share of pixels whose flow forth and back agrees."""
    travels: float
    """Median length of what no turn of the camera explains, as a share of the median flow; NaN where nothing agrees."""

    @property
    def same_place(self) -> bool:
        """Whether the two can be neighbours of one film."""
        return self.agrees >= SAME_PLACE

    @property
    def static(self) -> bool:
        """Whether the camera stood still between them."""
        return self.same_place and self.flow < STATIC


def small_copy(image: np.ndarray) -> np.ndarray:
    """Grey copy (h, WIDTH) uint8 of an image (H, W, 3)."""
    height = max(16, round(image.shape[0] * WIDTH / image.shape[1]))
    return cv2.resize(cv2.cvtColor(image, cv2.COLOR_RGB2GRAY), (WIDTH, height), interpolation=cv2.INTER_AREA)


class MotionMeter:
    """Measures motion between small copies of frames.

    Args:
        focal: focal length as a share of the frame's width.
    """

    def __init__(self, focal: float) -> None:
        self._focal = focal * WIDTH
        self._flow = cv2.DISOpticalFlow_create(cv2.DISOPTICAL_FLOW_PRESET_FAST)

    def __call__(self, before: np.ndarray, after: np.ndarray) -> Motion:
        """Motion from one small copy to the next of the same size."""
        forth, back = self._flow.calc(before, after, None), self._flow.calc(after, before, None)
        rows, columns = np.mgrid[: before.shape[0], : before.shape[1]].astype(np.float32)
        target = columns + forth[..., 0], rows + forth[..., 1]
        returned = cv2.remap(back, *target, cv2.INTER_LINEAR, borderMode=cv2.BORDER_CONSTANT, borderValue=(1e3, 1e3))
        length = np.linalg.norm(forth, axis=-1)
        agreeing = np.linalg.norm(forth + returned, axis=-1) < 0.5 + 0.1 * length
        if agreeing.sum() < 64:
            return Motion(float(np.median(length)) / WIDTH, float(agreeing.mean()), float("nan"))
        flow = float(np.median(length[agreeing]))
        left = self._not_turned(columns[agreeing], rows[agreeing], forth[agreeing], before.shape)
        return Motion(flow / WIDTH, float(agreeing.mean()), left / max(flow, 1e-6))

    def _not_turned(self, columns: np.ndarray, rows: np.ndarray, flow: np.ndarray, shape: tuple[int, ...]) -> float:
        """Median length, in pixels, of flow (N, 2) that is left when the small rotation that explains most of it is taken off.

        A rotation's flow does not depend on depth (H. C. Longuet-Higgins and K. Prazdny, 1980); fitted by reweighted least squares.
        """
        chosen = slice(None, None, max(1, len(flow) // 2000))
        x, y = (columns[chosen] - shape[1] / 2) / self._focal, (rows[chosen] - shape[0] / 2) / self._focal
        # (N, 2, 3): flow per unit of the rotation vector
        turning = self._focal * np.stack([np.stack([x * y, -(1 + x**2), y], -1), np.stack([1 + y**2, -x * y, -x], -1)], -2)
        target = flow[chosen]
        left, weight = target, np.ones(len(target), np.float32)
        for _ in range(5):
            weighted = (turning * weight[:, None, None]).reshape(-1, 3)
            rotation = np.linalg.lstsq(weighted, (target * weight[:, None]).ravel(), rcond=None)[0]
            left = target - turning @ rotation
            weight = 1 / np.sqrt(np.maximum(np.linalg.norm(left, axis=-1), 0.05))
        return float(np.median(np.linalg.norm(left, axis=-1)))
