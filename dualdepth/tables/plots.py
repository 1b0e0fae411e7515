"""Pictures: depth in a perceptual colour map with a scale in metres, errors beside it."""

import io
from collections.abc import Collection, Sequence
from typing import Any

import cv2
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure

NEAR, FAR = 3.0, 80.0  # Metres at the ends of the colour scale of depth.
POINT_RADIUS = 2.5  # Pixels that a laser point is enlarged by in pictures of errors.


class Picture(Figure):
    """A figure that shows itself in a notebook, without pyplot's global state."""

    def _repr_png_(self) -> bytes:
        buffer = io.BytesIO()
        self.savefig(buffer, dpi=80)
        return buffer.getvalue()


def show_image(axes: Axes, image: np.ndarray, title: str) -> None:
    """Draw an image (H, W, 3), uint8 or in [0, 1], without ticks."""
    axes.imshow(image)
    axes.set_title(title, fontsize=8, loc="left")
    axes.set_axis_off()


def show_depth(axes: Axes, depth: np.ndarray, title: str, bar: bool = True, unit: str = "m") -> None:
    """Draw a depth map (H, W) in metres, 0 = unknown (grey), with a colour bar in metres, or in another `unit`: near is bright, far is
    dark, logarithmic in depth, so that both show."""
    ticks = {value: str(value) for value in (3, 5, 10, 20, 40)} | {80: f"80 {unit}"}
    _show_map(axes, np.ma.masked_less_equal(depth, 0), title, ticks if bar else {}, "both", cmap="magma_r", norm=LogNorm(NEAR, FAR))


def show_error(axes: Axes, error: np.ndarray, title: str) -> None:
    """Draw |prediction − truth| / truth (H, W), NaN = no truth (grey), 0 … 0.5."""
    ticks = {0: "0", 0.25: "25%", 0.5: "50%"}
    _show_map(axes, np.ma.masked_invalid(error), title, ticks, "max", cmap="viridis", vmin=0, vmax=0.5)


def _show_map(axes: Axes, values: np.ma.MaskedArray, title: str, ticks: dict[float, str], extend: str, **style: Any) -> None:
    axes.set_facecolor("0.85")
    drawn = axes.imshow(values, interpolation="nearest", **style)
    axes.set_title(title, fontsize=8, loc="left")
    axes.set(xticks=[], yticks=[])
    if ticks:
        colours = axes.figure.colorbar(drawn, ax=axes, fraction=0.012, pad=0.01, extend=extend)
        colours.set_ticks([*ticks], labels=[*ticks.values()], fontsize=6)
        colours.minorticks_off()


def thicken(sparse: np.ndarray) -> np.ndarray:
    """Enlarge the points of a sparse map (H, W; 0 = none) to 5×5 pixels, the nearest depth on top, so that they show in a figure."""
    inverse = np.where(sparse > 0, 1.0 / np.maximum(sparse, 1e-3), 0).astype(np.float32)
    grown = cv2.dilate(inverse, np.ones((5, 5), np.uint8))
    return np.where(grown > 0, 1.0 / np.maximum(grown, 1e-6), 0)


def point_errors(prediction: np.ndarray, truth: np.ndarray) -> np.ndarray:
    """|prediction − truth| / truth (H, W) at the points of a sparse truth (0 = none), spread to the pixels nearest to each; else NaN."""
    from scipy.ndimage import distance_transform_edt

    if not (truth > 0).any():
        return np.full(truth.shape, np.nan)
    error = np.abs(prediction - truth) / np.maximum(truth, 1e-3)
    distance, nearest = distance_transform_edt(truth <= 0, return_indices=True)
    return np.where(distance <= POINT_RADIUS, error[tuple(nearest)], np.nan)


def map_rows(
    images: Sequence[np.ndarray],
    maps: dict[str, Sequence[np.ndarray]],
    titles: Sequence[str],
    *,
    windows: Sequence[tuple[slice, slice]] | None = None,
    unit: str = "m",
    errors: Collection[str] = (),
) -> Picture:
    """Frames in rows: each image (H, W, 3), then one map (H, W) for each name in `maps`, 0 = unknown.

    Maps are depth in metres or in another `unit`; those named in `errors` are relative errors, NaN = unknown. `windows` are the rows and
    columns of each frame that are shown, instead of all.
    """
    last = [name for name in maps if name not in errors][-1:]  # which has the colour bar
    windows = windows or [np.s_[:, :]] * len(images)
    columns, (height, width, _) = 1 + len(maps), images[0][windows[0]].shape
    figure = Picture(figsize=(13.0, len(images) * (12.4 / columns * (height / width) + 0.22) + 0.1), layout="constrained")
    cells = figure.subplots(len(images), columns, squeeze=False)
    for row, window, image, title, *values in zip(cells, windows, images, titles, *maps.values()):
        show_image(row[0], image[window], title)
        for axes, name, value in zip(row[1:], maps, values):
            if name in errors:
                show_error(axes, value[window], name)
            else:
                show_depth(axes, value[window], name, bar=[name] == last, unit=unit)
    return figure


def depth_comparison(
    images: Sequence[np.ndarray], truths: Sequence[np.ndarray], predictions: Sequence[np.ndarray], titles: Sequence[str]
) -> Picture:
    """Rows of image (H, W, 3), laser depth (H, W) in metres, 0 = no return, predicted depth, already scaled to it, and relative error."""
    errors = [point_errors(prediction, truth) for prediction, truth in zip(predictions, truths)]
    maps = {"laser": [thicken(truth) for truth in truths], "predicted": predictions, "relative error": errors}
    return map_rows(images, maps, titles, errors=["relative error"])


def image_grid(images: Sequence[np.ndarray], titles: Sequence[str], columns: int = 3) -> Picture:
    """Images (H, W, 3) in rows of `columns`."""
    rows = -(-len(images) // columns)
    figure = Picture(figsize=(13, 1.6 * rows), layout="constrained")
    for place, (image, title) in enumerate(zip(images, titles), 1):
        show_image(figure.add_subplot(rows, columns, place), image, title)
    return figure


def image_spread(scores: dict[str, pd.DataFrame]) -> Picture:
    """Histograms over images: Abs Rel, and the median-scaling ratio by its median; one colour per method."""
    figure = Picture(figsize=(10, 2.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    errors = pd.DataFrame({name: frame["abs_rel"] for name, frame in scores.items()})
    ratios = pd.DataFrame({name: frame["scale_ratio"] / frame["scale_ratio"].median() for name, frame in scores.items()})
    errors.plot.hist(ax=left, bins=30, alpha=0.6, title="Abs Rel of an image", ylabel="images")
    ratios.plot.hist(ax=right, bins=30, alpha=0.6, title="median-scaling ratio / its median", ylabel="", legend=False)
    return figure


def learning_curve(log: pd.DataFrame) -> Picture:
    """Photometric loss, step size and spread of disparity over the steps of a training's log, each with its running mean."""
    columns = ["photometric", "translation", "disparity_spread"]
    titles = ["photometric loss", "pose: translation (depth units)", "disparity: spread / mean"]
    figure = Picture(figsize=(12, 2.8), layout="constrained")
    values = log.set_index("step")[columns]
    axes = figure.subplots(1, len(columns))
    values.plot(ax=axes, subplots=True, title=titles, legend=False, color="C0", lw=0.5, alpha=0.4)
    values.rolling(max(len(log) // 15, 1), min_periods=1).mean().plot(ax=axes, subplots=True, legend=False, grid=True, color="C0")
    return figure


def cost_bars(costs: pd.DataFrame) -> Picture:
    """Operations, and time in both precisions, of networks by name (index): columns gmacs, latency_ms, latency_ms_bf16, device."""
    figure = Picture(figsize=(12, 0.4 * len(costs) + 1), layout="constrained")
    left, right = figure.subplots(1, 2, sharey=True)
    costs["gmacs"].plot.barh(ax=left, color="0.6", title="10⁹ multiply-accumulates", ylabel="")
    times = costs[["latency_ms", "latency_ms_bf16"]].dropna(axis="columns", how="all")
    times.plot.barh(ax=right, title=f"milliseconds an image on {costs['device'].iloc[0]}", ylabel="")
    right.legend(["float32", "bf16"], fontsize=7)
    left.invert_yaxis()
    return figure


def motions(pairs: dict[str, tuple[np.ndarray, np.ndarray]]) -> Picture:
    """Predicted against true yaw in degrees and forward step in metres: true and predicted (N, 2) by title, a column a sequence."""
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
    """Trajectories seen from above, a panel a sequence: x to the right and z up, in metres, at equal scale. Of positions (N, 3) by sequence
    and method; a sequence's first method is the truth, drawn in black."""
    figure = Picture(figsize=(5 * len(paths), 4.5), layout="constrained")
    for axes, (title, methods) in zip(figure.subplots(1, len(paths), squeeze=False)[0], paths.items()):
        for number, (method, positions) in enumerate(methods.items()):
            style = {"color": "black", "linewidth": 2} if number == 0 else {"color": f"C{number - 1}", "linewidth": 1.2}
            axes.plot(positions[:, 0], positions[:, 2], label=method, **style)
        axes.plot(0, 0, "o", color="black", markersize=5)
        axes.set(title=title, xlabel="x in metres", ylabel="z in metres", aspect="equal", adjustable="datalim")
        axes.grid(color="0.9")
    figure.axes[0].legend(frameon=False, fontsize="small")
    return figure
