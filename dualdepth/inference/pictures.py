"""Depth in colours with a bar, drawn fast enough for video."""

from typing import NamedTuple

import cv2
import numpy as np

TICKS = 5
SMALLEST = 120
"""Pixels of height that the bar's words need; lower pictures are put on a ground of that height."""
GROUND, INK = (24, 24, 24), (235, 235, 235)


class Range(NamedTuple):
    """Ends of a colour scale, in inverse depth."""

    far: float
    near: float

    @classmethod
    def of(cls, depth: np.ndarray) -> "Range":
        """From the 2nd to the 98th percentile of inverse depth, so that a few pixels do not take all colours."""
        step = max(1, min(depth.shape) // 256)  # a sample is enough, and at 4K much faster
        far, near = np.percentile(1.0 / depth[::step, ::step], (2, 98))
        return cls(float(far), float(max(near, far * 1.001)))

    def towards(self, other: "Range", share: float = 0.1) -> "Range":
        """A step to another range; a video's colours follow its frames without flicker."""
        return Range(*(old + share * (new - old) for old, new in zip(self, other)))


def colours(depth: np.ndarray, scale: Range) -> np.ndarray:
    """(H, W, 3) uint8 RGB of depth (H, W), linear in inverse depth: far is dark, near is bright."""
    share = (1.0 / depth - scale.far) / (scale.near - scale.far)
    return cv2.applyColorMap((np.clip(share, 0, 1) * 255).round().astype(np.uint8), cv2.COLORMAP_MAGMA)[..., ::-1]


def picture(depth: np.ndarray, scale: Range, unit: str, image: np.ndarray | None = None) -> np.ndarray:
    """Depth (H, W) in colours and the bar, with the image (H, W, 3) to their left if given: (max(H, 120), [W +] W + bar, 3) uint8 RGB."""
    parts = [colours(depth, scale)] if image is None else [image, colours(depth, scale)]
    height = max(SMALLEST, depth.shape[0])
    padded = [cv2.copyMakeBorder(part, 0, height - part.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=GROUND) for part in parts]
    return np.hstack([*padded, _bar(height, scale, unit)])


def _bar(height: int, scale: Range, unit: str) -> np.ndarray:
    """The colour bar with depths at its ticks and `unit` below, (height, w, 3)."""
    size = height / 900 + 0.25
    thick = max(1, round(2 * size))
    (_, line), _ = cv2.getTextSize("0", cv2.FONT_HERSHEY_SIMPLEX, size, thick)
    words = unit.split()
    top, bottom = 2 * line, height - 2 * line - round(1.6 * line * len(words))
    strip, gap = 2 * line, line // 2 + 1
    labels = [f"{1 / (scale.far + (scale.near - scale.far) * i / (TICKS - 1)):.3g}" for i in range(TICKS)]
    widest = max(cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, size, thick)[0][0] for word in [*labels, *words])
    panel = np.full((height, 2 * gap + strip + gap + widest + gap, 3), GROUND, np.uint8)
    panel[top : bottom + 1, 2 * gap : 2 * gap + strip] = colours(1 / np.linspace(2, 1, bottom - top + 1)[:, None], Range(1, 2))
    texts = [(label, 3 * gap + strip, round(bottom - (bottom - top) * i / (TICKS - 1))) for i, label in enumerate(labels)]
    texts += [(word, 2 * gap, bottom + round(1.6 * line * i)) for i, word in enumerate(words, 1)]
    for text, x, y in texts:
        cv2.putText(panel, text, (x, y + line // 2), cv2.FONT_HERSHEY_SIMPLEX, size, INK, thick, cv2.LINE_AA)
    return panel
