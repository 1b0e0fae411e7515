"""Pictures: depth in a perceptual colour map with a scale in metres, errors beside it."""

import io
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

from dualdepth.files import atomic_path

DEPTH_MAP = "magma_r"
"""Near is bright, far is dark; logarithmic in depth, so that near and far both show."""
NEAR, FAR = 3.0, 80.0
"""Metres at the ends of the colour scale."""
POINT_RADIUS = 2.5
"""Pixels that a laser point is enlarged by in pictures of errors."""


class Picture(Figure):
    """A figure that shows itself in a notebook, without pyplot's global state."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, dpi=80)
        return buffer.getvalue()


def save(figure: Figure, path: str | Path, dpi: int = 100) -> Path:
    """Write a figure as PNG, atomically."""
    with atomic_path(path) as partial:
        figure.savefig(partial, dpi=dpi)
    return Path(path)


def show_image(axes: Axes, image: np.ndarray, title: str = "") -> None:
    """Draw an image (H, W, 3), uint8 or in [0, 1], without ticks."""
    axes.imshow(image)
    axes.set_title(title, fontsize=8, loc="left")
    axes.set_axis_off()


def show_depth(axes: Axes, depth: np.ndarray, title: str = "", bar: bool = True, unit: str = "m") -> None:
    """Draw a depth map (H, W) in metres, 0 = unknown (grey), with a colour bar in metres, or in another `unit`."""
    shown = np.ma.masked_less_equal(depth, 0)
    axes.set_facecolor("0.85")
    drawn = axes.imshow(shown, cmap=DEPTH_MAP, norm=LogNorm(NEAR, FAR), interpolation="nearest")
    axes.set_title(title, fontsize=8, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])
    if bar:
        colours = axes.figure.colorbar(drawn, ax=axes, fraction=0.012, pad=0.01, extend="both")
        colours.set_ticks([3, 5, 10, 20, 40, 80], labels=["3", "5", "10", "20", "40", f"80 {unit}"], fontsize=6)
        colours.minorticks_off()


def show_error(axes: Axes, error: np.ndarray, title: str = "", top: float = 0.5) -> None:
    """Draw |prediction − truth| / truth (H, W), NaN = no truth (grey), 0 … `top`."""
    axes.set_facecolor("0.85")
    drawn = axes.imshow(np.ma.masked_invalid(error), cmap="viridis", vmin=0, vmax=top, interpolation="nearest")
    axes.set_title(title, fontsize=8, loc="left")
    axes.set_xticks([])
    axes.set_yticks([])
    colours = axes.figure.colorbar(drawn, ax=axes, fraction=0.012, pad=0.01, extend="max")
    colours.set_ticks([0, top / 2, top], labels=["0", f"{top / 2:.0%}", f"{top:.0%}"], fontsize=6)


def thicken(sparse: np.ndarray, pixels: int = 5) -> np.ndarray:
    """Enlarge the points of a sparse map (H, W; 0 = none) to squares, the nearest depth on top, so that they show in a figure."""
    import cv2

    inverse = np.where(sparse > 0, 1.0 / np.maximum(sparse, 1e-3), 0).astype(np.float32)
    grown = cv2.dilate(inverse, np.ones((pixels, pixels), np.uint8))
    return np.where(grown > 0, 1.0 / np.maximum(grown, 1e-6), 0)


def point_errors(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """|prediction − truth| / truth (H, W) at the points of a sparse truth (0 = none), spread to the pixels nearest to each; else NaN."""
    from scipy.ndimage import distance_transform_edt

    if not (truth > 0).any():
        return np.full(truth.shape, np.nan)
    error = np.abs(prediction - truth) / np.maximum(truth, 1e-3)
    distance, nearest = distance_transform_edt(truth <= 0, return_indices=True)
    return np.where(distance <= POINT_RADIUS, error[tuple(nearest)], np.nan)


def depth_comparison(
    images: Sequence[np.ndarray], truths: Sequence[np.ndarray], predictions: Sequence[np.ndarray], titles: Sequence[str]
) -> Picture:
    """Rows of image, laser depth, predicted depth, relative error.

    Args:
        images: (H, W, 3) each.
        truths: (H, W) metres, 0 = no return.
        predictions: (H, W) metres, already scaled to the truth.
        titles: one per row.
    """
    figure = Picture(figsize=(13, 1.35 * len(images) + 0.2), layout="constrained")
    axes = figure.subplots(len(images), 4, squeeze=False)
    for row, image, truth, prediction, title in zip(axes, images, truths, predictions, titles):
        show_image(row[0], image, title)
        show_depth(row[1], thicken(truth), "laser", bar=False)
        show_depth(row[2], prediction, "predicted")
        show_error(row[3], point_errors(prediction, truth), "relative error")
    return figure


def image_grid(images: Sequence[np.ndarray], titles: Sequence[str], columns: int = 3) -> Picture:
    """Images (H, W, 3) in rows of `columns`."""
    rows = -(-len(images) // columns)
    figure = Picture(figsize=(13, 1.6 * rows), layout="constrained")
    cells = figure.subplots(rows, columns, squeeze=False).flat
    for axes in cells:
        axes.set_axis_off()
    for axes, image, title in zip(figure.axes, images, titles):
        show_image(axes, image, title)
    return figure


def depth_pair(image: np.ndarray, depth: np.ndarray, image_title: str, depth_title: str) -> Picture:
    """An image (H, W, 3) and its depth map (H, W) in metres side by side."""
    figure = Picture(figsize=(13, 2.2), layout="constrained")
    left, right = figure.subplots(1, 2)
    show_image(left, image, image_title)
    show_depth(right, depth, depth_title)
    return figure


def truth_overlay(images: Sequence[np.ndarray], truths: Sequence[np.ndarray], titles: Sequence[str]) -> Picture:
    """Rows of image and its laser depth (H, W), metres."""
    figure = Picture(figsize=(13, 2.1 * len(images)), layout="constrained")
    for (left, right), image, truth, title in zip(figure.subplots(len(images), 2, squeeze=False), images, truths, titles):
        show_image(left, image, title)
        show_depth(right, thicken(truth), "laser depth")
    return figure


def image_spread(scores: dict[str, pd.DataFrame]) -> Picture:
    """Histograms over images: Abs Rel, and the median-scaling ratio by its median; one colour per method."""
    figure = Picture(figsize=(10, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    for name, frame in scores.items():
        left.hist(frame["abs_rel"], bins=30, alpha=0.6, label=name)
        right.hist(frame["scale_ratio"] / frame["scale_ratio"].median(), bins=30, alpha=0.6, label=name)
    left.set_title("Abs Rel of an image", fontsize=9, loc="left")
    right.set_title("median-scaling ratio / its median", fontsize=9, loc="left")
    left.set_ylabel("images")
    left.legend(fontsize=7)
    return figure


def training_panel(target: np.ndarray, synthesized: np.ndarray, disparity: np.ndarray, error: np.ndarray) -> Picture:
    """One sample of a batch: target, warped source (3, H, W), relative depth and photometric error (H, W)."""
    figure = Picture(figsize=(10, 3.4), layout="constrained")
    (top_left, top_right), (bottom_left, bottom_right) = figure.subplots(2, 2)
    show_image(top_left, target.transpose(1, 2, 0).clip(0, 1), "target")
    show_image(top_right, synthesized.transpose(1, 2, 0).clip(0, 1), "source, warped to the target")
    bottom_left.imshow(disparity / disparity.mean(), cmap="magma", vmin=0, vmax=3)
    bottom_left.set_title("disparity / its mean, 0 … 3", fontsize=8, loc="left")
    bottom_left.set_axis_off()
    bottom_right.imshow(error, cmap="viridis", vmin=0, vmax=0.5)
    bottom_right.set_title("photometric error, 0 … 0.5", fontsize=8, loc="left")
    bottom_right.set_axis_off()
    return figure


def learning_curve(logs: dict[str, pd.DataFrame]) -> Picture:
    """Loss components, step sizes and spreads over the steps; one line per run."""
    panels = {
        "photometric": "photometric loss",
        "translation": "pose: translation (depth units)",
        "disparity_spread": "disparity: spread / mean",
    }
    figure = Picture(figsize=(12, 2.8), layout="constrained")
    for axes, (column, title) in zip(figure.subplots(1, len(panels)), panels.items()):
        for name, log in logs.items():
            axes.plot(log["step"], log[column], lw=0.5, alpha=0.4)
            smooth = log[column].rolling(max(len(log) // 15, 1), min_periods=1).mean()
            axes.plot(log["step"], smooth, color=axes.lines[-1].get_color(), label=name)
        axes.set_title(title, fontsize=9, loc="left")
        axes.set_xlabel("step")
        axes.grid(alpha=0.3)
    axes.legend(fontsize=7)
    return figure


def cost_bars(costs: pd.DataFrame) -> Picture:
    """Operations, and time in both precisions, of networks by name (index): columns gmacs, latency_ms, latency_ms_bf16, device."""
    figure = Picture(figsize=(12, 0.4 * len(costs) + 1), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    places = np.arange(len(costs))[::-1]
    left.barh(places, costs["gmacs"], color="0.6")
    left.set_yticks(places, costs.index, fontsize=8)
    left.set_title("10⁹ multiply-accumulates", fontsize=9, loc="left")
    right.barh(places + 0.2, costs["latency_ms"], 0.4, label="float32")
    if costs["latency_ms_bf16"].notna().any():
        right.barh(places - 0.2, costs["latency_ms_bf16"], 0.4, label="bf16")
    right.set_title(f"milliseconds an image on {costs['device'].iloc[0]}", fontsize=9, loc="left")
    right.legend(fontsize=7)
    return figure


def motions(pairs: dict[str, tuple[np.ndarray, np.ndarray]]) -> Picture:
    """Predicted against true yaw and forward step, a column a sequence.

    Args:
        pairs: true and predicted (N, 2), yaw in degrees and step in metres, by title.
    """
    figure = Picture(figsize=(3.6 * len(pairs), 6.4), layout="constrained")
    panels = figure.subplots(2, len(pairs), squeeze=False)
    for column, (title, (truth, ours)) in enumerate(pairs.items()):
        for axes, which, what in zip(panels[:, column], (0, 1), ("yaw, ° a frame", "forward step, m a frame")):
            axes.axline((truth[:, which].mean(),) * 2, slope=1, color="0.7", linewidth=1)
            axes.plot(truth[:, which], ours[:, which], ".", markersize=3)
            axes.set(xlabel=f"true {what}", ylabel=f"predicted {what}")
        panels[0, column].set_title(title)
    return figure


def trajectories(paths: dict[str, dict[str, np.ndarray]]) -> Picture:
    """Trajectories seen from above, a panel a sequence: x to the right and z up, in metres, at equal scale.

    Args:
        paths: positions (N, 3) by sequence and method; a sequence's first method is the truth, drawn in black.
    """
    figure = Picture(figsize=(5 * len(paths), 4.5), layout="constrained")
    for axes, (title, methods) in zip(figure.subplots(1, len(paths), squeeze=False)[0], paths.items()):
        for number, (method, positions) in enumerate(methods.items()):
            style = {"color": "black", "linewidth": 2} if number == 0 else {"color": f"C{number - 1}", "linewidth": 1.2}
            axes.plot(positions[:, 0], positions[:, 2], label=method, **style)
        axes.plot(0, 0, "o", color="black", markersize=5)
        axes.set(title=title, xlabel="x in metres", ylabel="z in metres", aspect="equal")
        axes.set_adjustable("datalim")
        axes.grid(color="0.9")
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure
