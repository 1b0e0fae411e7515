"""The paper's qualitative figures, remade from our own predictions, and the drawing of the networks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import FancyArrowPatch, FancyBboxPatch

from dualdepth.evaluation.distance import FAR
from dualdepth.evaluation.objects import POLE
from dualdepth.plots import Picture, show_depth, show_error, show_image


class Window(NamedTuple):
    """A part of an image, in pixels."""

    top: int
    left: int
    height: int
    width: int

    def of(self, values: np.ndarray) -> np.ndarray:
        """The part of (H, W, …)."""
        return values[self.top : self.top + self.height, self.left : self.left + self.width]


def around(row: float, column: float, shape: Sequence[int], share: float = 0.3) -> Window:
    """A window of `share` of the image's height and twice as wide, centred as near to (row, column) as the image allows."""
    height = max(round(share * shape[0]), 8)
    width = min(2 * height, shape[1])
    top = int(np.clip(row - height / 2, 0, shape[0] - height))
    left = int(np.clip(column - width / 2, 0, shape[1] - width))
    return Window(top, left, height, width)


def interpolated(sparse: np.ndarray) -> np.ndarray:
    """Laser depth (H, W; 0 = none) between its points, linear in inverse depth; 0 above the highest point. For pictures, not for scores."""
    from scipy.interpolate import griddata
    from scipy.spatial import QhullError

    rows, columns = np.nonzero(sparse)
    grid = np.mgrid[: sparse.shape[0], : sparse.shape[1]]
    try:
        inverse = griddata((rows, columns), 1 / sparse[rows, columns], tuple(grid), method="linear", fill_value=0.0)
    except (QhullError, ValueError):  # too few points, or all on one line
        return sparse
    return np.where(inverse > 0, 1 / np.maximum(inverse, 1e-3), 0)


def boundary_window(depth: np.ndarray) -> Window:
    """Where depth (H, W) jumps most: the window with the largest steps from left to right, on a logarithmic scale."""
    import cv2

    steps = np.abs(np.diff(np.log(np.maximum(depth, 1e-3)), axis=1)).clip(max=1)
    steps[depth[:, 1:] * depth[:, :-1] <= 0] = 0
    spread = max(0.3 * depth.shape[0], 8) / 3
    density = cv2.GaussianBlur(steps, (0, 0), sigmaX=2 * spread, sigmaY=spread, borderType=cv2.BORDER_CONSTANT)
    row, column = np.unravel_index(density.argmax(), density.shape)
    return around(row + 0.5, column + 1, depth.shape)


def far_window(truth: np.ndarray) -> Window | None:
    """Where most laser points beyond 20 m lie; None where there are none."""
    far = truth > FAR
    return around(*np.argwhere(far).mean(0), truth.shape) if far.any() else None


def pole_window(labels: np.ndarray) -> Window | None:
    """Around the largest pole; None where there is none of 20 pixels or more."""
    import cv2

    count, _, stats, centres = cv2.connectedComponentsWithStats((labels == POLE).astype(np.uint8))
    if count < 2 or stats[1:, cv2.CC_STAT_AREA].max() < 20:
        return None
    column, row = centres[1 + stats[1:, cv2.CC_STAT_AREA].argmax()]
    return around(row, column, labels.shape, 0.5)


def depth_rows(images: Sequence[np.ndarray], depths: dict[str, Sequence[np.ndarray]], titles: Sequence[str], unit: str = "m") -> Picture:
    """Frames in rows: image, then one depth map in metres, or in another `unit`, for each name in `depths`."""
    figure = Picture(figsize=_size(images[0].shape, len(images), 1 + len(depths)), layout="constrained")
    cells = figure.subplots(len(images), 1 + len(depths), squeeze=False)
    for number, (row, image, title) in enumerate(zip(cells, images, titles)):
        show_image(row[0], image, title)
        for axes, (name, maps) in zip(row[1:], depths.items()):
            show_depth(axes, maps[number], name, bar=axes is row[-1], unit=unit)
    return figure


def close_ups(
    images: Sequence[np.ndarray],
    depths: dict[str, Sequence[np.ndarray]],
    windows: Sequence[Window],
    titles: Sequence[str],
    unit: str = "m",
) -> Picture:
    """Windows of frames in rows: image, then each depth map, in metres or in another `unit`."""
    parts = {name: [w.of(d) for w, d in zip(windows, maps)] for name, maps in depths.items()}
    return depth_rows([w.of(i) for w, i in zip(windows, images)], parts, titles, unit)


def far_errors(
    images: Sequence[np.ndarray], errors: dict[str, Sequence[np.ndarray]], windows: Sequence[Window], titles: Sequence[str]
) -> Picture:
    """Windows of frames in rows: image, then relative errors (NaN = unknown), which show where distant objects go wrong."""
    figure = Picture(figsize=_size((windows[0].height, windows[0].width), len(images), 1 + len(errors)), layout="constrained")
    cells = figure.subplots(len(images), 1 + len(errors), squeeze=False)
    for number, (row, image, window, title) in enumerate(zip(cells, images, windows, titles)):
        show_image(row[0], window.of(image), title)
        for axes, (name, maps) in zip(row[1:], errors.items()):
            show_error(axes, window.of(maps[number]), name)
    return figure


def _size(shape: Sequence[int], rows: int, columns: int) -> tuple[float, float]:
    """Figure size in inches for a grid of pictures of `shape` = (H, W, …) with a line of text above each."""
    return 13.0, rows * (12.4 / columns * shape[0] / shape[1] + 0.22) + 0.1


BOXES = {
    "image": (0.0, 4.2, 1.7, 1.0, "HR image\n384×1248", "0.93"),
    "small": (0.0, 0.6, 1.7, 1.0, "LR image\n128×416", "0.93"),
    "lr encoder": (2.6, 0.6, 1.9, 1.0, "LR-Net\nencoder", "#cfe2f3"),
    "lr decoder": (7.9, 0.6, 1.9, 1.0, "LR-Net\ndecoder", "#cfe2f3"),
    "lr depth": (10.6, 0.6, 1.7, 1.0, "LR depth", "0.93"),
    "attention": (5.2, 2.4, 2.0, 1.0, "SA-Attention\nf″ = Σ w f′", "#f9d7b9"),
    "hr encoder": (2.6, 4.2, 1.9, 1.0, "HR-Net\nencoder", "#d5ead0"),
    "join": (5.2, 4.2, 2.0, 1.0, "concatenate\nat stride 32", "#d5ead0"),
    "hr decoder": (7.9, 4.2, 1.9, 1.0, "HR-Net\ndecoder", "#d5ead0"),
    "hr depth": (10.6, 4.2, 1.7, 1.0, "HR depth", "0.93"),
    "frames": (0.0, -1.4, 1.7, 1.0, "3 LR frames", "0.93"),
    "pose": (2.6, -1.4, 1.9, 1.0, "PoseNet", "#e4d7ee"),
    "poses": (5.2, -1.4, 2.0, 1.0, "2 poses", "0.93"),
    "loss": (10.6, -1.4, 1.7, 1.0, "view synthesis\nwith the depth", "#f4cccc"),
}
"""Left, bottom, width, height, text, colour of the drawing's boxes."""
ARROWS = (
    ("image", "small", "3×3 mean"),
    ("image", "hr encoder", ""),
    ("small", "lr encoder", ""),
    ("lr encoder", "lr decoder", "skips"),
    ("lr decoder", "lr depth", ""),
    ("lr encoder", "attention", "deepest features"),
    ("small", "attention", "colours, coordinates"),
    ("attention", "join", "enlarged ×3"),
    ("hr encoder", "join", ""),
    ("join", "hr decoder", "skips"),
    ("hr decoder", "hr depth", ""),
    ("frames", "pose", ""),
    ("pose", "poses", ""),
    ("poses", "loss", ""),
    ("lr depth", "loss", "stage 1"),
)


def overview() -> Picture:
    """The networks and how they join (paper, figure "Overview of our method"): blue is frozen in stage 2, green and orange learn then."""
    figure = Picture(figsize=(12, 6.4), layout="constrained")
    axes = figure.subplots()
    for left, bottom, width, height, text, colour in BOXES.values():
        axes.add_patch(FancyBboxPatch((left, bottom), width, height, boxstyle="round,pad=0.05", fc=colour, ec="0.3", lw=0.8))
        axes.text(left + width / 2, bottom + height / 2, text, ha="center", va="center", fontsize=9)
    for start, end, text in ARROWS:
        _arrow(axes, BOXES[start], BOXES[end], text)
    curve = FancyArrowPatch(
        (12.36, 4.7), (12.36, -0.9), connectionstyle="arc3,rad=-0.25", arrowstyle="-|>", mutation_scale=11, lw=0.9, color="0.3"
    )
    axes.add_patch(curve)
    axes.text(13.1, 2.6, "stage 2", fontsize=7, color="0.3")
    axes.text(0, 5.5, "blue: stage 1, frozen in stage 2    green, orange: stage 2    violet: both stages", fontsize=9)
    axes.set(xlim=(-0.3, 13.7), ylim=(-1.7, 5.9), aspect="equal")
    axes.set_axis_off()
    return figure


def _arrow(axes: Axes, start: tuple, end: tuple, text: str) -> None:
    x0, y0, w0, h0 = start[:4]
    x1, y1, w1, h1 = end[:4]
    if x1 >= x0 + w0:  # from left to right
        tail, tip = (x0 + w0 + 0.06, y0 + h0 / 2), (x1 - 0.06, y1 + h1 / 2)
    elif y1 > y0:
        tail, tip = (x0 + w0 / 2, y0 + h0 + 0.06), (x1 + w1 / 2, y1 - 0.06)
    else:
        tail, tip = (x0 + w0 / 2, y0 - 0.06), (x1 + w1 / 2, y1 + h1 + 0.06)
    axes.add_patch(FancyArrowPatch(tail, tip, arrowstyle="-|>", mutation_scale=11, lw=0.9, color="0.3", shrinkA=0, shrinkB=0))
    vertical = tail[0] == tip[0]
    x, y = (tail[0] + tip[0]) / 2, (tail[1] + tip[1]) / 2
    axes.text(
        x + (0.1 if vertical else 0),
        y + (0 if vertical else 0.12),
        text,
        ha="left" if vertical else "center",
        va="center" if vertical else "bottom",
        fontsize=7,
        color="0.3",
    )
