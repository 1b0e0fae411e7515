"""Band-limited noise in tiles that repeat without a seam, made once from fixed phases."""

import cv2
import numpy as np

SIDE = 512  # Texels of a tile.


def _tile(seed: int, slope: float, finest: float) -> np.ndarray:
    """Noise with amplitude falling as frequency^-slope, nothing finer than `finest` texels; (SIDE, SIDE) float32, deviation 1."""
    spectrum = np.fft.rfft2(np.random.default_rng(seed).normal(size=(SIDE, SIDE)))
    frequency = np.hypot(np.fft.fftfreq(SIDE)[:, None], np.fft.rfftfreq(SIDE)[None])
    frequency[0, 0] = 1.0
    gain = frequency**-slope * np.exp(-((frequency * finest / 1.2) ** 4))
    gain[0, 0] = 0.0
    tile = np.fft.irfft2(spectrum * gain, (SIDE, SIDE))
    return (tile / tile.std()).clip(-2.5, 2.5).astype(np.float32)


GRAIN = _tile(11, 0.9, 2.5)  # Fine structure of all sizes: asphalt, plaster, grass, leaves.
BLOTCH = _tile(12, 1.7, 6.0)  # Smooth large-scale variation: stains, clouds, clumps.


def noise(tile: np.ndarray, x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Look up a tile, bilinearly.

    Args:
        tile: `GRAIN` or `BLOTCH`.
        x, y: (N,) in tiles, of any size; N below 32,767 (OpenCV's limit).

    Returns:
        (N,) float32, mean 0, deviation 1.
    """
    x, y = (((a - np.floor(a)) * SIDE).astype(np.float32)[None] for a in (x, y))
    return cv2.remap(tile, x, y, cv2.INTER_LINEAR, borderMode=cv2.BORDER_WRAP)[0]


def fade(footprint: np.ndarray, size: float) -> np.ndarray:
    """Weight of detail of `size` metres where a ray covers `footprint` metres: 1 up close, towards 0 far away."""
    return 1 / (1 + (footprint / np.float32(size)) ** 2)
