"""Random scale and crop at full resolution, then one resample to HR-Net's size (paper, "Implementation Details")."""

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np

from dualdepth.sections import Augmentation


class Window(NamedTuple):
    """The part of a frame that is seen, in whole pixels, and whether it is mirrored."""

    left: int
    top: int
    width: int
    height: int
    flip: bool = False


def draw_window(size: tuple[int, int], settings: Augmentation, rng: np.random.Generator) -> Window:
    """Draw a crop window of a frame of `size` (height, width).

    Enlarging by s and cropping back to the frame's size shows a window of 1/s of it; x and y are drawn independently,
    s ~ U(1, max_scale), as in SfMLearner and GeoNet. Whole pixels keep the intrinsics exact.
    """
    height, width = size
    scale_x, scale_y = rng.uniform(1.0, settings.max_scale, 2)
    window_width, window_height = round(width / scale_x), round(height / scale_y)
    left = int(rng.integers(0, width - window_width + 1))
    top = int(rng.integers(0, height - window_height + 1))
    flip = settings.beyond_paper_flip and bool(rng.random() < 0.5)
    return Window(left, top, window_width, window_height, flip)


def full_window(size: tuple[int, int]) -> Window:
    """The whole frame of `size` (height, width)."""
    return Window(0, 0, size[1], size[0])


def resize(image: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Resample (H, W, C) to `size` (height, width): area averages where it shrinks, bilinear where it grows."""
    shrinks = image.shape[0] >= size[0] and image.shape[1] >= size[1]
    return cv2.resize(image, (size[1], size[0]), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def view(image: np.ndarray, window: Window, size: tuple[int, int]) -> np.ndarray:
    """The window of a frame (H, W, 3), resampled once to `size`."""
    part = image[window.top : window.top + window.height, window.left : window.left + window.width]
    part = resize(part, size)
    return part[:, ::-1] if window.flip else part


def view_intrinsics(matrix: np.ndarray, window: Window, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics (3, 3) of `view`: the principal point moves with the crop, then all scale about pixel centres."""
    scale_x, scale_y = size[1] / window.width, size[0] / window.height
    result = matrix.astype(np.float64).copy()
    result[0, 2] = (result[0, 2] - window.left + 0.5) * scale_x - 0.5
    result[1, 2] = (result[1, 2] - window.top + 0.5) * scale_y - 0.5
    result[0, 0] *= scale_x
    result[1, 1] *= scale_y
    if window.flip:
        result[0, 2] = size[1] - 1 - result[0, 2]
    return result


def augment(
    frames: Sequence[np.ndarray], matrix: np.ndarray, size: tuple[int, int], settings: Augmentation, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """One draw for all frames of a triplet.

    Args:
        frames: (H, W, 3) uint8 each, of one size.
        matrix: intrinsics (3, 3) of the raw frame.
        size: HR size (height, width). With `augment_first` off (the order the paper calls worse) frames are first shrunk to a
            third of it, the LR size, and cropped there; the result then has the LR size.
        settings: of the augmentation.
        rng: fixes the draw.

    Returns:
        (len(frames), h, w, 3) uint8 and the view's intrinsics (3, 3) float64.
    """
    if not settings.augment_first:
        size = (size[0] // 3, size[1] // 3)
        matrix = view_intrinsics(matrix, full_window(frames[0].shape[:2]), size)
        frames = [resize(frame, size) for frame in frames]
    window = draw_window(frames[0].shape[:2], settings, rng)
    return np.stack([view(frame, window, size) for frame in frames]), view_intrinsics(matrix, window, size)
