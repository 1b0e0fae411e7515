"""Predicts files in their order: read ahead, computed in batches, written behind."""

import os
import sys
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import nullcontext
from itertools import groupby, islice
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from dualdepth.data.frames import Video
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.inference.journal import Journal, Task, identity, recipe
from dualdepth.inference.outputs import Style, save
from dualdepth.inference.pictures import Range, side_by_side
from dualdepth.inference.videos import Writer, video_writer
from dualdepth.model import DepthModel

GPU_BATCH = 16
"""Images at a time on a GPU, halved until they fit; on a CPU one at a time is as fast as several."""


class Item(NamedTuple):
    """An image on its way."""

    task: Task
    was: dict[str, int]
    """The file's identity before it was read."""
    image: np.ndarray | None = None
    trouble: str | None = None
    """Why there is no image."""
    depth: np.ndarray | None = None


class Predictor:
    """Writes what is predicted of files into a folder, and keeps count.

    Args:
        model: that predicts.
        out: the folder.
        journal: of the folder.
        weights: what identifies them, and the precision.
        style: what is said and assumed in results.
        batch_size: images computed together; None chooses.
    """

    def __init__(self, model: DepthModel, out: Path, journal: Journal, weights: str, style: Style, batch_size: int | None = None) -> None:
        self.model, self.out, self.journal, self.weights, self.style = model, out, journal, weights, style
        self.batch_size = batch_size or (GPU_BATCH if model.device.type == "cuda" else 1)
        self.made = 0
        """Inputs whose results were written."""
        self.troubles: list[str] = []
        """A line for each input that was broken."""

    def run(self, tasks: Sequence[Task]) -> None:
        """Do all tasks. A broken input is named on stderr and left out.

        Raises:
            InputError: results cannot be written, or the network gives no numbers.
        """
        workers = min(8, os.cpu_count() or 1)
        try:
            with ThreadPoolExecutor(workers) as pool:
                for video, group in groupby(tasks, lambda task: task.video):
                    if not video:
                        self._images(list(group), pool, 2 * workers)
                        continue
                    for task in group:
                        self._video(task, pool, 2 * workers)
        except OSError as error:
            raise InputError(f"{self.out}: results cannot be written ({error}); the same command then goes on where it was") from None

    def tell(self, trouble: str) -> None:
        """Note that an input is broken, and say so."""
        self.troubles.append(trouble)
        tqdm.write(f"broken: {trouble}", file=sys.stderr)

    def _images(self, tasks: Sequence[Task], pool: Executor, most: int) -> None:
        with _bar(len(tasks), "predicting", "image") as bar:
            read = ahead(pool, _read, tasks, self.batch_size + most)
            for item in ahead(pool, self._save, self._predicted(read), most):
                if item.trouble:
                    self.tell(item.trouble)
                else:
                    self._note(item.task, item.was)
                bar.update()

    def _save(self, item: Item) -> Item:
        """Write an image's results; gives on what was done, without the pixels."""
        if item.image is not None:
            for kind in item.task.kinds:
                save(kind, self.out / item.task.file(kind), item.image, item.depth, self.style)
        return item._replace(image=None, depth=None)

    def _video(self, task: Task, pool: Executor, most: int) -> None:
        was = identity(task.path)
        try:
            video = Video(task.path)
        except InputError as error:
            self.tell(str(error))
            return
        with video_writer(self.out / task.file("side"), video.rate) if "side" in task.kinds else nullcontext() as writer:
            count = self._frames(task, video, writer, pool, most)
        trouble = f"{video.missing}, and its results hold those" if video.missing else None
        self._note(task, was, frames=count, **({"trouble": trouble} if trouble else {}))
        if trouble:
            self.tell(f"{task.path}: {trouble}")

    def _frames(self, task: Task, video: Video, writer: Writer | None, pool: Executor, most: int) -> int:
        """Predict a video's frames and write what is asked for of them; how many there were."""

        def drawn(numbered: tuple[int, Item, Range]) -> np.ndarray | None:
            number, item, colours = numbered
            for kind in (kind for kind in task.kinds if kind != "side"):
                save(kind, self.out / task.file(kind, number), item.image, item.depth, self.style, colours)
            return side_by_side(item.image, item.depth, colours, self.style.unit) if writer else None

        def coloured(items: Iterable[Item]) -> Iterator[tuple[int, Item, Range]]:
            colours = None
            for number, item in enumerate(items):
                own = Range.of(item.depth)
                colours = colours.towards(own) if colours else own
                yield number, item, colours

        count = 0
        with _bar(video.announced, task.path.name, "frame") as bar:
            frames = (Item(task, {}, cv2.resize(frame, video.size[::-1])) for _, frame in video.frames())
            for frame in ahead(pool, drawn, coloured(self._predicted(frames)), most):
                if writer:
                    writer.write(frame)
                count += 1
                bar.update()
        return count

    def _predicted(self, items: Iterable[Item]) -> Iterator[Item]:
        """The same with depths, in the same order."""
        items = iter(items)
        while batch := list(islice(items, self.batch_size)):
            depths = self._depths([item.image for item in batch if item.image is not None])
            yield from (item if item.image is None else item._replace(depth=depths.pop(0)) for item in batch)

    def _depths(self, images: list[np.ndarray]) -> list[np.ndarray]:
        """Depths of images, in smaller batches from now on where the GPU's memory is too small."""
        depths: list[np.ndarray] = []
        while len(depths) < len(images):
            try:
                depths += self.model.predict_batch(images[len(depths) : len(depths) + self.batch_size])
            except torch.OutOfMemoryError:
                if self.batch_size == 1:
                    raise InputError(f"{self.model.device}: too little memory for one image; give --device cpu") from None
                self.batch_size //= 2
        return [depth * np.float32(self.style.scale) for depth in depths]

    def _note(self, task: Task, was: dict[str, int], **facts: int | str) -> None:
        made = {kind: recipe(kind, self.weights, self.style) for kind in task.kinds}
        about = {"unit": self.style.unit, "about": self.style.about, "device": str(self.model.device), "precision": self.model.precision}
        self.journal.note(task.path, task.name, made, was, **about, **facts)
        self.made += 1


def ahead(pool: Executor, work: Callable[[Any], Any], items: Iterable[Any], most: int) -> Iterator[Any]:
    """`map(work, items)` by a pool, with at most `most` items taken that were not yet given on."""
    pending = deque()
    for item in items:
        pending.append(pool.submit(work, item))
        if len(pending) >= most:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()


def _read(task: Task) -> Item:
    was = identity(task.path)
    try:
        return Item(task, was, read_image(task.path))
    except InputError as error:
        return Item(task, was, trouble=str(error))


def _bar(total: int | None, what: str, unit: str) -> tqdm:
    """Progress with rate and time left, also where stderr is a file, there in fewer lines."""
    return tqdm(total=total, desc=what, unit=unit, disable=total == 0, mininterval=0.2 if sys.stderr.isatty() else 10)
