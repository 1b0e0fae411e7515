"""Predicts files: read ahead, computed in batches, written behind."""

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from dualdepth.data.frames import Video
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.inference.inputs import Task
from dualdepth.inference.outputs import Style, save, write_video
from dualdepth.inference.pictures import Range, picture
from dualdepth.model import DepthModel

GPU_BATCH = 16
"""Images at a time on a GPU, halved until they fit; on a CPU one at a time is as fast as several."""
WORKERS = min(8, os.cpu_count() or 1)
"""Threads that read, draw and write."""


class Item(NamedTuple):
    """An image or a video's frame on its way."""

    task: Task
    image: np.ndarray
    number: int = 0
    """Of a video's frame."""
    depth: np.ndarray | None = None
    colours: Range | None = None
    """Ends of a video frame's colour scale; an image has its own."""


class Predictor:
    """Writes what is predicted of files into a folder, and keeps count.

    Args:
        model: that predicts.
        out: the folder.
        style: what is said and assumed in results.
        batch_size: images computed together; None chooses.
    """

    def __init__(self, model: DepthModel, out: Path, style: Style, batch_size: int | None = None) -> None:
        self.model, self.out, self.style = model, out, style
        self.batch_size = batch_size or (GPU_BATCH if model.device.type == "cuda" else 1)
        self.made = self.broken = 0
        """Inputs whose results were written, and inputs that could not be read, or not to their end."""

    def run(self, tasks: Sequence[Task]) -> None:
        """Do all tasks, the images first. A broken input is named on stderr and left out.

        Raises:
            OSError: results cannot be written.
            InputError: the network gives no numbers.
        """
        with ThreadPoolExecutor(WORKERS) as pool:
            images = [task for task in tasks if not task.video]
            read = ahead(pool, _read, images, self.batch_size + 2 * WORKERS)
            with _bar(read, len(images), "predicting", "image") as bar:
                for _ in ahead(pool, self._save, self._predicted(self._whole(bar))):
                    self.made += 1
            for task in tasks:
                if task.video:
                    self._video(task, pool)

    def _tell(self, trouble: str) -> None:
        self.broken += 1
        tqdm.write(f"broken: {trouble}", file=sys.stderr)

    def _whole(self, items: Iterable[Item | InputError]) -> Iterator[Item]:
        """The images that could be read."""
        for item in items:
            if isinstance(item, InputError):
                self._tell(str(item))
            else:
                yield item

    def _save(self, item: Item) -> None:
        """Write the files of an image or a video's frame."""
        for kind in item.task.kinds:
            if not (item.task.video and kind == "side"):
                save(kind, self.out / item.task.file(kind, item.number), item.image, item.depth, self.style, item.colours)

    def _video(self, task: Task, pool: Executor) -> None:
        """Predict a video. The files of its first frame are written last, and so say that all are there."""
        try:
            video = Video(task.path)
        except InputError as error:
            self._tell(str(error))
            return
        side, first = "side" in task.kinds, []

        def drawn(item: Item) -> np.ndarray | None:
            if item.number == 0:
                first.append(item)
            else:
                self._save(item)
            return picture(item.depth, item.colours, self.style.unit, item.image) if side else None

        frames = (Item(task, cv2.resize(frame, video.size[::-1]), number=number) for number, frame in video.frames())
        pictures = ahead(pool, drawn, _coloured(self._predicted(frames)))
        with _bar(pictures, video.announced, task.path.name, "frame") as bar:
            if side:
                write_video(self.out / task.file("side"), video.rate, bar)
            else:
                deque(bar, maxlen=0)
        self._save(first[0])
        self.made += 1
        if video.missing:
            self._tell(f"{task.path}: {video.missing}, and its results hold those")

    def _predicted(self, items: Iterator[Item]) -> Iterator[Item]:
        """The same with depths, in the same order; in smaller batches from now on where the GPU's memory is too small."""
        batch: list[Item] = []
        while batch := batch or list(islice(items, self.batch_size)):
            try:
                depths = self.model.predict_batch([item.image for item in batch[: self.batch_size]])
            except torch.OutOfMemoryError:
                if self.batch_size == 1:
                    raise InputError(f"{self.model.device}: too little memory for one image; give --device cpu") from None
                self.batch_size //= 2
                continue
            yield from (item._replace(depth=depth * np.float32(self.style.scale)) for item, depth in zip(batch, depths))
            batch = batch[len(depths) :]


def ahead(pool: Executor, work: Callable[[Any], Any], items: Iterable[Any], most: int = 2 * WORKERS) -> Iterator[Any]:
    """`map(work, items)` by a pool, with at most `most` items taken that were not yet given on."""
    pending = deque()
    for item in items:
        pending.append(pool.submit(work, item))
        if len(pending) >= most:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()


def _read(task: Task) -> Item | InputError:
    try:
        return Item(task, read_image(task.path))
    except InputError as error:
        return error


def _coloured(items: Iterable[Item]) -> Iterator[Item]:
    """A video's frames with colour scales that follow their depths slowly."""
    colours = None
    for item in items:
        own = Range.of(item.depth)
        colours = colours.towards(own) if colours else own
        yield item._replace(colours=colours)


def _bar(items: Iterable[Any], total: int | None, what: str, unit: str) -> "tqdm[Any]":
    """The items, with progress, rate and time left, also where stderr is a file, there in fewer lines."""
    return tqdm(items, total=total, desc=what, unit=unit, disable=total == 0, mininterval=0.2 if sys.stderr.isatty() else 10)
