"""What is written of images and their depth: 16-bit PNG, colours with a bar, array, point cloud, video. Each file is whole or absent."""

import math
import os
from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
import PIL.Image
import PIL.PngImagePlugin

from dualdepth.data.camera import Camera, centred_camera, focal_length
from dualdepth.errors import note
from dualdepth.files import atomic_path

SUFFIXES = {"colour": ".colour.png", "depth": ".depth.png", "side": ".side.png", "npy": ".depth.npy", "ply": ".ply"}
"""Endings of an image's results, by kind."""
SIDE_VIDEO = ".side.mp4"
PNG_FACTOR = 256  # A PNG's value / 256 is the depth, as in KITTI's depth maps.
CODEC = "mp4v"  # MPEG-4 in MP4, which every OpenCV wheel writes.
WIDEST = 3840  # Pixels; wider or higher side-by-side frames are shrunk, since players refuse them.
KITTI_FIELD_OF_VIEW = 2 * math.degrees(math.atan(1242 / 2 / 721.5377))
"""Degrees, horizontal, of KITTI's colour cameras (81.4); the default, since profiles `sample` and `paper` learn from such images."""
TICKS, WIDEST_LABEL, SMALLEST = 5, "1.23e+45", 120
"""Of the colour bar; its width is the same for all depths, and below so many pixels of height a picture is put on a ground."""
GROUND, INK = (24, 24, 24), (235, 235, 235)


class Style(NamedTuple):
    """What results say, and the camera that point clouds assume: the first of its three settings that is not None counts."""

    about: str  # What the network learned from.
    scale: float = 1.0  # What relative depth is multiplied by.
    intrinsics: tuple[float, float, float, float] | None = None
    """fx, fy, cx, cy in pixels of the image; pixel (0, 0) is the centre of the first pixel."""
    focal: float | None = None  # fx = fy in pixels of the image, with the principal point in its middle.
    field_of_view: float | None = None  # Degrees, horizontal; None: KITTI's.

    def camera(self, size: tuple[int, int]) -> Camera:
        """The camera of an image of `size` (height, width)."""
        if self.intrinsics:
            return Camera(*self.intrinsics, size, "fx {} fy {} cx {} cy {} as given".format(*self.intrinsics))
        if self.focal is not None:
            focal, note = self.focal, f"focal length {self.focal} pixels as given"
        else:
            degrees, by = (self.field_of_view, "as given") if self.field_of_view else (KITTI_FIELD_OF_VIEW, "by default, as KITTI's")
            focal, note = focal_length(degrees, size[1]), f"horizontal field of view {degrees:.1f} degrees {by}"
        return centred_camera(focal, size, f"{note}, principal point in the middle")

    @property
    def unit(self) -> str:
        """What a number in a result is."""
        return "relative depth" if self.scale == 1 else f"relative depth x{self.scale:g}"


def save(kind: str, path: Path, image: np.ndarray, depth: np.ndarray, style: Style, ends: np.ndarray | None = None) -> None:
    """Write one result of a `kind` of `SUFFIXES`: of an image (H, W, 3) uint8 RGB and its depth (H, W) float32, scaled.
    `ends` are those of the colour scale; None takes the depth's own, `colour_ends`. An `OSError` says that it cannot be written."""
    with atomic_path(path) as partial:
        if kind == "depth":
            words = PIL.PngImagePlugin.PngInfo()
            words.add_itxt("Description", f"value / {PNG_FACTOR} = {style.unit}; 65535 = {65535 / PNG_FACTOR:.0f} or more. {style.about}")
            values = np.clip(np.rint(depth * PNG_FACTOR), 1, 65535).astype(np.uint16)  # 0 would stand for none
            if (values == 65535).mean() > 0.01:
                note(f"depth from 256 up is cut off in PNG files; --scale {style.scale / 10:g} or --save npy keeps it")
            PIL.Image.fromarray(values).save(partial, pnginfo=words, compress_level=3)
        elif kind == "npy":
            np.save(partial, depth)
        elif kind == "ply":
            _save_ply(partial, image, depth, style)
        else:
            ends = colour_ends(depth) if ends is None else ends
            drawn = picture(depth, ends, style.unit, image if kind == "side" else None)
            partial.write_bytes(cv2.imencode(".png", drawn[..., ::-1])[1])


def _save_ply(path: Path, image: np.ndarray, depth: np.ndarray, style: Style) -> None:
    """All pixels as points, row by row; x right, y down, z forward."""
    fx, fy, cx, cy, _, note, _ = style.camera(depth.shape)
    rows, columns = np.indices(depth.shape, np.float32)
    names = {"x": "float", "y": "float", "z": "float", "red": "uchar", "green": "uchar", "blue": "uchar"}
    points = np.empty(depth.shape, [(name, "<f4" if kind == "float" else "u1") for name, kind in names.items()])
    values = ((columns - cx) / fx * depth, (rows - cy) / fy * depth, depth, *np.moveaxis(image, 2, 0))
    for name, value in zip(names, values):
        points[name] = value
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment x right, y down, z forward; in units of {style.unit}",
        f"comment camera: {note}",
        f"comment {' '.join(style.about.encode('ascii', 'replace').decode().split())}",
        f"element vertex {points.size}",
        *(f"property {kind} {name}" for name, kind in names.items()),
        "end_header\n",
    ]
    with path.open("wb") as file:
        file.write("\n".join(header).encode("ascii"))
        points.tofile(file)


def colour_ends(depth: np.ndarray) -> np.ndarray:
    """Ends (far, near) of a colour scale: the 2nd and 98th percentile of 1 / depth (H, W), so that few pixels do not take all colours."""
    step = max(1, min(depth.shape) // 256)  # a sample is enough, and at 4K much faster
    far, near = np.percentile(1.0 / depth[::step, ::step], (2, 98))
    return np.array([far, max(near, far * 1.25)])  # of a nearly flat wall, whose noise would else take them all


def colours_of(depth: np.ndarray, ends: np.ndarray) -> np.ndarray:
    """(H, W, 3) uint8 RGB of depth (H, W), linear in inverse depth between `ends`: far is dark, near is bright."""
    share = (1.0 / depth - ends[0]) / (ends[1] - ends[0])
    return cv2.applyColorMap((np.clip(share, 0, 1) * 255).round().astype(np.uint8), cv2.COLORMAP_MAGMA)[..., ::-1]


def picture(depth: np.ndarray, ends: np.ndarray, unit: str, image: np.ndarray | None = None) -> np.ndarray:
    """Depth (H, W) in colours and the bar, with the image (H, W, 3) to their left if given: (max(H, 120), [W +] W + bar, 3) uint8 RGB."""
    parts = [*([] if image is None else [image]), colours_of(depth, ends)]
    height = max(SMALLEST, depth.shape[0])
    padded = [cv2.copyMakeBorder(part, 0, height - part.shape[0], 0, 0, cv2.BORDER_CONSTANT, value=GROUND) for part in parts]
    return np.hstack([*padded, _bar(height, ends, unit)])


def _bar(height: int, ends: np.ndarray, unit: str) -> np.ndarray:
    """The colour bar with depths at its ticks and `unit` below, (height, w, 3); by OpenCV, since matplotlib takes 15 times as long."""
    size = height / 900 + 0.25
    thick = max(1, round(2 * size))
    words, labels = unit.split(), [f"{1 / inverse:.3g}" for inverse in np.linspace(*ends, TICKS)]
    sizes = [cv2.getTextSize(word, cv2.FONT_HERSHEY_SIMPLEX, size, thick)[0] for word in [WIDEST_LABEL, *words]]
    widest, line = max(width for width, _ in sizes), sizes[0][1]
    top, bottom = 2 * line, height - 2 * line - round(1.6 * line * len(words))
    strip, gap = 2 * line, line // 2 + 1
    panel = np.full((height, 2 * gap + strip + gap + widest + gap, 3), GROUND, np.uint8)
    panel[top : bottom + 1, 2 * gap : 2 * gap + strip] = colours_of(1 / np.linspace(2, 1, bottom - top + 1)[:, None], np.array([1, 2]))
    places = [(3 * gap + strip, round(y)) for y in np.linspace(bottom, top, TICKS)]
    places += [(2 * gap, bottom + round(1.6 * line * i)) for i in range(1, len(words) + 1)]
    for text, (x, y) in zip([*labels, *words], places):
        cv2.putText(panel, text, (x, y + line // 2), cv2.FONT_HERSHEY_SIMPLEX, size, INK, thick, cv2.LINE_AA)
    return panel


def write_video(path: Path, rate: float, frames: Iterable[np.ndarray]) -> None:
    """Write frames (H, W, 3) uint8 RGB of one size, `rate` a second; the file is whole or absent. A `NotImplementedError` says that the
    codec takes no such video, an `OSError` that not all frames were written; the codec tells of no full disk, so they are counted.

    The codec needs even sides; an odd one gets its last row or column twice. The rate is rounded to as many decimals as the codec takes;
    frames are written several times where that is below 0.1, of which OpenCV takes three decimals."""
    times = math.ceil(0.1 / rate)
    rate = round(times * rate, max(0, int(math.log10(65535 / (times * rate)))))  # a fraction of whole numbers of 16 bits
    with atomic_path(path) as partial:
        file, count = cv2.VideoWriter(), 0
        try:
            for count, frame in enumerate(frames, 1):
                if (longest := max(frame.shape)) > WIDEST:
                    height, width = (max(2, round(side * WIDEST / longest)) for side in frame.shape[:2])
                    frame = cv2.resize(frame, (width, height), interpolation=cv2.INTER_AREA)
                frame = cv2.copyMakeBorder(frame, 0, frame.shape[0] % 2, 0, frame.shape[1] % 2, cv2.BORDER_REPLICATE)
                settings = (cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*CODEC), rate, frame.shape[1::-1])
                if count == 1 and not file.open(os.fsencode(partial), *settings):
                    raise NotImplementedError(f"OpenCV cannot write {CODEC} of {settings[-1]} at {rate:g} Hz; try --save depth")
                for _ in range(times):
                    file.write(np.ascontiguousarray(frame[..., ::-1]))
        finally:
            file.release()
        capture = cv2.VideoCapture(os.fsencode(partial), cv2.CAP_FFMPEG)
        written = int(capture.get(cv2.CAP_PROP_FRAME_COUNT)) // times
        capture.release()
        if written != count:
            raise OSError(f"{written} of {count} frames were written; is the disk full?")
