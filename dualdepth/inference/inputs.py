"""The images and videos that are meant by files, folders and patterns, and what is left to do for each, by make's rule.

A result is kept if it is newer than the time since which its input and all options are the same.
"""

import glob
import itertools
import json
import time
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dualdepth.data.frames import IMAGES
from dualdepth.errors import InputError
from dualdepth.files import write_text
from dualdepth.inference.outputs import ENDINGS, SIDE_VIDEO, SUFFIXES

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")
STAMP = "predictions.json"
"""In the folder of results: the options that shaped them and since when (ns) these are the same; and, by the name of its results, each
input's path, its own time (ns) and since when it has that. An input replaced by an older file so counts as changed."""
LONGEST = 120
"""Bytes of a result's name before its ending; file systems allow 255, and a temporary name is longer."""
DEFAULT_KINDS = {False: ("colour", "depth"), True: ("side",)}
"""What is made of images (False) and videos (True) where nothing else is asked for."""


def find_inputs(given: Iterable[str | Path]) -> list[Path]:
    """Files in the order given, each once.

    A file is taken whatever its ending. A folder stands for the images and videos in it (not below it), by name; a pattern
    (`*`, `?`, `[…]`, `**`) for those that match it. Of both, hidden files and results of an earlier prediction are left out.

    Raises:
        InputError: something is not there, or there are no images or videos in it.
    """
    return list({path.resolve(): path for word in given for path in _files(str(word))}.values())


def _files(word: str) -> list[Path]:
    path = Path(word)
    if path.is_file():
        return [path]
    if path.is_dir():
        candidates = list(path.iterdir())
    elif glob.has_magic(word):
        candidates = [Path(name) for name in glob.glob(word, recursive=True)]
    else:
        raise InputError(f"{word}: no such file or folder; give an image, a video, a folder or a pattern in quotes")
    usable = sorted(path for path in candidates if path.suffix.lower() in IMAGES + VIDEOS and path.is_file())
    usable = [path for path in usable if not path.name.startswith(".") and not path.name.lower().endswith(ENDINGS)]
    if not usable:
        raise InputError(f"{word}: no images or videos there; known endings are {' '.join(IMAGES + VIDEOS)}")
    return usable


class Task(NamedTuple):
    """One input and what is to be made of it."""

    path: Path
    name: str
    """Of its results."""
    kinds: tuple[str, ...] = ()
    """Kinds of results still to be written; empty if all exist."""

    @property
    def video(self) -> bool:
        """Whether the input is read as a video, by its ending."""
        return self.path.suffix.lower() in VIDEOS

    def file(self, kind: str, frame: int = 0) -> str:
        """Name of a result below the folder of results; a video has one of a kind for each frame, but `side` is a video again."""
        if not self.video:
            return f"{self.name}{SUFFIXES[kind]}"
        return f"{self.name}{SIDE_VIDEO}" if kind == "side" else f"{self.name}.frames/{frame:06d}{SUFFIXES[kind]}"


def plan(paths: Sequence[Path], out: Path, options: dict[str, str], kinds: Sequence[str] | None, overwrite: bool) -> list[Task]:
    """A task for each input, in their order; results that are there are not made again, unless other options shaped them.

    Args:
        paths: of the inputs.
        out: folder of the results; `STAMP` is written into it.
        options: what shapes results, beside input and kind.
        kinds: keys of `SUFFIXES`; None takes `DEFAULT_KINDS`.
        overwrite: make again what is there.
    """
    before, since, inputs = _read_stamp(out / STAMP)
    if before != options:
        if changed := [name for name in options if before and before.get(name) != options[name]]:
            print(f"{out}: its results were made with other {', '.join(changed)}; they are made again")
        since = time.time_ns()
    tasks = []
    for path in paths:
        task = Task(path, _name(path, inputs))
        entry, changed = inputs[task.name], _changed(path)
        if entry["changed"] != changed:
            entry |= {"changed": changed, "since": time.time_ns()}
        latest = max(since, entry["since"])
        wanted = kinds or DEFAULT_KINDS[task.video]
        tasks.append(task._replace(kinds=tuple(kind for kind in wanted if overwrite or _changed(out / task.file(kind)) <= latest)))
    write_text(out / STAMP, json.dumps({"options": options, "since": since, "inputs": inputs}, indent=1) + "\n")
    return tasks


def _read_stamp(path: Path) -> tuple[dict[str, str], int, dict[str, dict[str, Any]]]:
    """Options, since when, and inputs by the names of their results; nothing where there is no stamp that can be read."""
    try:
        stamp: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
        inputs = {name: {key: entry[key] for key in ("path", "changed", "since")} for name, entry in stamp["inputs"].items()}
        return dict(stamp["options"]), int(stamp["since"]), inputs
    except (OSError, ValueError, TypeError, KeyError, AttributeError):
        return {}, 0, {}


def _name(path: Path, inputs: dict[str, dict[str, Any]]) -> str:
    """The name of a file's results: its stem, with -2, -3, … where another file has that already. It is added to `inputs`."""
    stem = path.stem.encode("utf-8", "surrogateescape")[:LONGEST].decode("utf-8", "ignore")
    for number in itertools.count(1):
        name = stem if number == 1 else f"{stem}-{number}"
        if inputs.setdefault(name, {"path": str(path.absolute()), "changed": -1, "since": 0})["path"] == str(path.absolute()):
            return name


def _changed(path: Path) -> int:
    """When a file was last changed, in ns; 0 where there is none."""
    try:
        return path.stat().st_mtime_ns
    except OSError:
        return 0
