"""Depth of files: which inputs are meant, which results are missing or out of date, and a pipeline that reads ahead, computes in
batches and writes behind.

A result is kept if it is newer than the time since which its input and all options are the same.
"""

import glob
import itertools
import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Executor, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from tqdm import tqdm

from dualdepth.data.frames import Video, is_image, media
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError, reading
from dualdepth.files import locked, remove_leftovers, write_text
from dualdepth.inference.results import SIDE_VIDEO, SUFFIXES, Style, colour_ends, picture, save, write_video
from dualdepth.model import DepthModel

STAMP = "predictions.json"
"""In the folder of results: the options that shaped them and since when (ns) these are the same; and, by the name of its results, each
input's path, its own time (ns) and since when it has that. So an input replaced by an older file counts as changed."""
LONGEST = 120  # Bytes of a result's name before its ending; file systems allow 255, and a temporary name is longer.
GPU_BATCH = 16  # Images at a time on a GPU, halved until they fit; on a CPU one at a time is as fast as several.
WORKERS = min(8, os.cpu_count() or 1)  # Threads that read, draw and write.
Given = Path | InputError  # A file, or why what was given stands for none.


def predict_files(
    paths: Sequence[Given], out: Path, model: DepthModel, style: Style, *, kinds: Sequence[str], batch_size: int | None, overwrite: bool
) -> bool:
    """Write what is predicted of files into a folder, say what comes of it, and keep results that are newer than what they are made of.
    `paths` are from `find_inputs`. `kinds` are keys of `SUFFIXES`; an empty sequence takes colour and depth of an image, side of a video.
    Returns whether all inputs could be read to their end; the others are named on stderr. An `InputError` says that results cannot be
    written, that another process writes there, or that the network gives no numbers."""
    options = {"weights": f"{model.card['sha256']}: {model.about}", "precision": model.precision, "scale": repr(style.scale)}
    options["camera"] = repr(style[2:])
    try:
        with locked(out / ".predict.lock"):
            for folder in (out, *out.glob("*.frames")):
                remove_leftovers(folder, below=False)
            tasks = plan([path for path in paths if isinstance(path, Path)], out, options, kinds, overwrite)
            todo = [task for task in tasks if task.kinds]
            if any("ply" in task.kinds for task in todo):
                print(f"point clouds: {style.camera((1, 1)).origin}")
            print(f"{len(todo)} of {len(tasks)} inputs to predict on {model.device} in {model.precision}", flush=True)
            predictor = Predictor(model, out, style, batch_size or (GPU_BATCH if model.device.type == "cuda" else 1))
            for error in (path for path in paths if isinstance(path, InputError)):
                predictor.tell(error)
            predictor.run(todo)
    except UnicodeEncodeError as error:
        raise InputError(f"{out}: this locale has no {error.object[error.start]!a} for names of files; set PYTHONUTF8=1") from None
    except OSError as error:
        print(f"{out}: stopped", flush=True)  # raises again if printing was the trouble
        raise InputError(f"{out}: results cannot be written ({error}); the same command then goes on where it was") from None
    there = f", {len(tasks) - len(todo)} were there" if len(todo) < len(tasks) else ""
    broken = f", {len(predictor.broken)} broken" if predictor.broken else ""
    names = f" ({', '.join(map(todo[0].file, todo[0].kinds))})" if len(todo) == predictor.made == 1 else ""
    print(f"{out}: {predictor.made} predicted{names}{there}{broken}")
    return not predictor.broken


def find_inputs(given: Iterable[str | Path]) -> list[Given]:
    """Files in the order given, each once. A file is taken whatever its ending. A folder stands for the images and videos in it (not below
    it), in natural order; a pattern (`*`, `?`, `[…]`, `**`) stands for those that match it. Hidden files and results of an earlier
    prediction are left out of both. An `InputError` names what is not there, or has no images or videos in it; it is in the list among
    files, and raised where there are none."""
    found: dict[str, Given] = {}
    for word in map(str, given):
        try:
            with reading(word, "give another one"):
                found |= {os.path.realpath(path): path for path in _files(word)}
        except InputError as error:
            found[f"broken: {word}"] = error
    if (first := next(iter(found.values()), None)) and not any(isinstance(path, Path) for path in found.values()):
        raise first
    return list(found.values())


def _files(word: str) -> list[Path]:
    path = Path(word)
    if path.is_file():
        return [path]
    if not path.is_dir() and not glob.has_magic(word):
        raise InputError(f"{word}: no such file or folder; give an image, a video, a folder or a pattern in quotes")
    candidates = list(path.iterdir() if path.is_dir() else map(Path, glob.glob(word, recursive=True)))
    if not candidates and not path.is_dir():
        raise InputError(f"{word}: no file matches this pattern; check its folder and its ending")
    made = {folder for folder in {path.parent for path in candidates} if any((f / STAMP).is_file() for f in (folder, folder.parent))}
    ours = (*SUFFIXES.values(), SIDE_VIDEO)
    return media([path for path in candidates if path.parent not in made or not path.name.lower().endswith(ours)], word)


class Task(NamedTuple):
    """One input and what is to be made of it."""

    path: Path
    name: str  # Of its results.
    video: bool  # Whether it is read as a video.
    kinds: tuple[str, ...] = ()  # Kinds of results still to be written; empty if all exist.

    def file(self, kind: str, frame: int = 0) -> str:
        """Name of a result below the folder of results; a video has one of a kind for each frame, but `side` is a video again."""
        if not self.video:
            return f"{self.name}{SUFFIXES[kind]}"
        return f"{self.name}{SIDE_VIDEO}" if kind == "side" else f"{self.name}.frames/{frame:06d}{SUFFIXES[kind]}"


def plan(paths: Sequence[Path], out: Path, options: dict[str, str], kinds: Sequence[str], overwrite: bool) -> list[Task]:
    """A task for each input, in their order; results that are there are not made again, unless other `options` shaped them. `STAMP` is
    written into `out`; the other arguments are those of `predict_files`."""
    try:
        stamp: dict[str, Any] = json.loads((out / STAMP).read_text(encoding="utf-8"))
        inputs = {n: {key: e[key] for key in ("path", "changed", "since")} | {"size": e.get("size")} for n, e in stamp["inputs"].items()}
        before, since = dict(stamp["options"]), int(stamp["since"])
    except (OSError, ValueError, TypeError, KeyError, AttributeError):  # there is none that can be read
        before, since, inputs = {}, 0, {}
    if before != options:
        if changed := [name for name in options if before and before.get(name) != options[name]]:
            print(f"{out}: its results were made with other {', '.join(changed)}; they are made again")
        since = time.time_ns()
    tasks = []
    for path in paths:
        changed, size = _changed(path), path.stat().st_size if path.exists() else 0
        task = Task(path, _name(path, inputs, changed, size), not is_image(path))
        entry = inputs[task.name]
        if entry["changed"] != changed:
            entry |= {"changed": changed, "since": time.time_ns()}
        latest = max(since, entry["since"])
        wanted = kinds or (("side",) if task.video else ("colour", "depth"))
        tasks.append(task._replace(kinds=tuple(kind for kind in wanted if overwrite or _changed(out / task.file(kind)) <= latest)))
    write_text(out / STAMP, json.dumps({"options": options, "since": since, "inputs": inputs}, indent=1) + "\n")
    return tasks


def _name(path: Path, inputs: dict[str, dict[str, Any]], changed: int, size: int) -> str:
    """The name of a file's results: its stem, with -2, -3, … where another file has that already. It is added to `inputs`. A file that was
    moved keeps its name: its former place is empty, and the time of its change and its size are the same."""
    here = str(path.absolute())
    stem = path.stem.encode("utf-8", "surrogateescape")[:LONGEST].decode("utf-8", "ignore")
    for name in itertools.chain([stem], (f"{stem}-{number}" for number in itertools.count(2))):
        entry = inputs.setdefault(name, {"path": here, "changed": -1, "since": 0, "size": None})
        moved = (entry["changed"], entry["size"]) == (changed, size) and not Path(entry["path"]).exists()
        if moved or os.path.realpath(entry["path"]) == os.path.realpath(path):
            entry |= {"path": here, "size": size}
            return name


def _changed(path: Path) -> int:
    """When a file was last changed, in ns; 0 where there is none."""
    return path.stat().st_mtime_ns if path.exists() else 0


class Item(NamedTuple):
    """An image or a video's frame on its way; a frame has a number, and a colour scale that follows its depths slowly."""

    task: Task
    image: np.ndarray
    number: int = 0
    depth: np.ndarray | None = None
    ends: np.ndarray | None = None


@dataclass
class Predictor:
    """Does tasks and keeps count; the fields are arguments of `predict_files`."""

    model: DepthModel
    out: Path
    style: Style
    batch_size: int
    made: int = 0  # Inputs whose results were written.
    broken: list[object] = field(default_factory=list)
    """What was said on stderr of inputs that could not be read, or not to their end, and are left out."""

    def run(self, tasks: Sequence[Task]) -> None:
        """Do all tasks, the images first."""
        images = [task for task in tasks if not task.video]
        with ThreadPoolExecutor(WORKERS) as pool:
            read = ahead(pool, self._read, images, self.batch_size + 2 * WORKERS)
            with _bar(read, len(images), "predicting", "image") as bar:
                for _ in ahead(pool, self._save, self._predicted(item for item in bar if item)):
                    self.made += 1
            for task in tasks:
                if task.video:
                    self._video(task, pool)

    def tell(self, trouble: object) -> None:
        """Name a broken input on stderr, and count it."""
        self.broken.append(trouble)
        tqdm.write(f"broken: {trouble}", file=sys.stderr)

    def _read(self, task: Task) -> Item | None:
        try:
            self._check_camera(task, (image := read_image(task.path)).shape)
            return Item(task, image)
        except InputError as error:
            return self.tell(error)

    def _check_camera(self, task: Task, size: Sequence[int]) -> None:
        """Refuse to make points of a picture (height, width) that does not hold the given principal point: it is of another size."""
        _, _, cx, cy = self.style.intrinsics or (0, 0, 0, 0)
        if "ply" in task.kinds and not (0 <= cx <= size[1] and 0 <= cy <= size[0]):
            where = f"{task.path}: {size[1]}x{size[0]} pixels do not hold the point CX {cx:g} CY {cy:g} of --intrinsics"
            raise InputError(f"{where}; give those of images of this size")

    def _video(self, task: Task, pool: Executor) -> None:
        """Predict a video. The files of its first frame are written last, and so say that all are there."""
        try:
            with reading(task.path, "copy it again"), task.path.open("rb"):  # OpenCV does not say that it may not
                video = Video(task.path)
            self._check_camera(task, video.size)
        except InputError as error:
            return self.tell(error)
        side, first, numbers = "side" in task.kinds, [], []

        def drawn(item: Item) -> np.ndarray | None:
            numbers.append(item.number)
            first.append(item) if item.number == 0 else self._save(item)
            return picture(item.depth, item.ends, self.style.unit, item.image) if side else None

        frames = (Item(task, cv2.resize(frame, video.size[::-1]), number) for number, frame in video.frames())
        with _bar(ahead(pool, drawn, _coloured(self._predicted(frames))), video.announced, task.path.name, "frame") as bar:
            try:
                write_video(self.out / task.file("side"), video.rate, bar) if side else deque(bar, maxlen=0)
            except NotImplementedError as error:
                return self.tell(f"{task.path}: {error}")
        endings = tuple(SUFFIXES[kind] for kind in task.kinds)
        for path in (self.out / f"{task.name}.frames").glob("[0-9]*.*"):  # of a longer film that had this name
            if path.name.endswith(endings) and (number := path.name.split(".")[0]).isdecimal() and int(number) > max(numbers):
                path.unlink()
        self._save(first[0])
        self.made += 1
        if video.missing:
            self.tell(f"{task.path}: {video.missing}, and its results hold those")

    def _save(self, item: Item) -> None:
        """Write the files of an image or a video's frame."""
        for kind in item.task.kinds:
            if not (item.task.video and kind == "side"):
                save(kind, self.out / item.task.file(kind, item.number), item.image, item.depth, self.style, item.ends)

    def _predicted(self, items: Iterator[Item]) -> Iterator[Item]:
        """The same with depths, in the same order; in smaller batches from now on where the GPU's memory is too small."""
        batch: list[Item] = []
        while batch := batch or list(itertools.islice(items, self.batch_size)):
            try:
                depths = self.model.predict_batch([item.image for item in batch[: self.batch_size]])
            except torch.OutOfMemoryError:
                if self.batch_size == 1:
                    raise InputError(f"{self.model.device}: too little memory for one image; give --device cpu") from None
                self.batch_size //= 2
                continue
            yield from (item._replace(depth=depth * np.float32(self.style.scale)) for item, depth in zip(batch, depths))
            batch = batch[len(depths) :]


def _coloured(items: Iterable[Item]) -> Iterator[Item]:
    """A video's frames with colour scales that move a tenth towards each frame's own, so that nothing flickers."""
    ends = None
    for item in items:
        own = colour_ends(item.depth)
        ends = own if ends is None else ends + 0.1 * (own - ends)
        yield item._replace(ends=ends)


def ahead(pool: Executor, work: Callable[[Any], Any], items: Iterable[Any], most: int = 2 * WORKERS) -> Iterator[Any]:
    """`map(work, items)` by a pool, with at most `most` items taken that were not yet given on."""
    pending = deque()
    for item in items:
        pending.append(pool.submit(work, item))
        if len(pending) >= most:
            yield pending.popleft().result()
    while pending:
        yield pending.popleft().result()


def _bar(items: Iterable[Any], total: int | None, what: str, unit: str) -> "tqdm[Any]":
    """The items, with progress, rate and time left, also where stderr is a file, there in fewer lines."""
    return tqdm(items, total=total, desc=what, unit=unit, disable=total == 0, mininterval=0.2 if sys.stderr.isatty() else 10)
