"""`predictions.jsonl`: which results are of which file, and what made them; so, what is left to do for each input."""

import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from dualdepth.inference.inputs import is_video
from dualdepth.inference.outputs import SIDE_VIDEO, SUFFIXES, Style

NAME = "predictions.jsonl"
LONGEST = 120
"""Bytes of a result's name before its ending; file systems allow 255, and a temporary name is longer."""
DEFAULT_KINDS = {False: ("colour", "depth"), True: ("side",)}
"""What is made of images (False) and videos (True) where nothing else is asked for."""


class Journal:
    """The results in a folder: a line of JSON a file, of which the last counts."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / NAME
        self._entries: dict[str, dict[str, Any]] = {}
        self._owners: dict[str, str] = {}
        text = self.path.read_text(encoding="utf-8", errors="replace") if self.path.exists() else ""
        self._torn = bool(text) and not text.endswith("\n")  # by a kill
        for line in text.splitlines():
            try:
                entry = json.loads(line)
                name, owner, made = entry["name"], entry["input"], entry["made"]
            except (ValueError, TypeError, KeyError):
                continue
            if isinstance(name, str) and isinstance(owner, str) and isinstance(made, dict):
                self._entries[owner] = entry
                self._owners[name] = owner

    def name(self, path: Path) -> str:
        """The name of a file's results: its stem, with -2, -3, … where another file has that already; the same in each run."""
        owner = str(path.absolute())
        if owner in self._entries:
            return self._entries[owner]["name"]
        stem = path.stem.encode("utf-8", "surrogateescape")[:LONGEST].decode("utf-8", "ignore")
        name, number = stem, 1
        while self._owners.get(name, owner) != owner:
            number += 1
            name = f"{stem}-{number}"
        self._owners[name] = owner
        return name

    def entry(self, path: Path) -> dict[str, Any]:
        """What is known of a file's results; nothing where there are none or the file has changed since."""
        entry = self._entries.get(str(path.absolute()), {})
        return entry if entry and all(entry.get(key) == value for key, value in identity(path).items()) else {}

    def note(self, path: Path, name: str, made: dict[str, str], was: dict[str, int], **facts: Any) -> None:
        """Note that results of a file are there.

        Args:
            path: the file.
            name: of its results.
            made: what made them, by kind.
            was: the file's `identity` before it was read.
            facts: to keep beside.

        Raises:
            OSError: it cannot be written.
        """
        before = self._entries.get(str(path.absolute()), {})
        if all(before.get(key) == value for key, value in was.items()):
            made = before.get("made", {}) | made
        entry = {"input": str(path.absolute()), **was, "name": name, "made": made, **facts}
        with self.path.open("a", encoding="utf-8") as file:
            file.write("\n" * self._torn + json.dumps(entry) + "\n")
        self._torn = False
        self._entries[entry["input"]] = entry


def identity(path: Path) -> dict[str, int]:
    """Size and time of a file, to notice that it was replaced; zeros where it is gone."""
    try:
        status = path.stat()
    except OSError:
        return {"bytes": 0, "mtime_ns": 0}
    return {"bytes": status.st_size, "mtime_ns": status.st_mtime_ns}


class Task(NamedTuple):
    """One input and what is to be made of it."""

    path: Path
    name: str
    """Of its results."""
    video: bool
    kinds: tuple[str, ...]
    """Kinds of results still to be written; empty if all exist."""
    trouble: str | None = None
    """What an earlier prediction said of it, where all are there."""

    def file(self, kind: str, frame: int = 0) -> str:
        """Name of a result below the folder of results; a video has one of a kind for each frame, but `side` is a video again."""
        if not self.video:
            return f"{self.name}{SUFFIXES[kind]}"
        return f"{self.name}{SIDE_VIDEO}" if kind == "side" else f"{self.name}.frames/{frame:06d}{SUFFIXES[kind]}"


def recipe(kind: str, weights: str, style: Style) -> str:
    """What shapes a result of a kind, beside its input."""
    return f"weights {weights}, scale {style.scale:g}" + f", {style.camera}" * (kind == "ply")


def plan(
    paths: Iterable[Path], out: Path, journal: Journal, weights: str, style: Style, kinds: Sequence[str] | None, overwrite: bool
) -> list[Task]:
    """A task for each input, in their order; results that are there and were made the same way are not made again.

    Args:
        paths: of the inputs.
        out: folder of the results.
        journal: of that folder.
        weights: what identifies them, and the precision.
        style: of the results.
        kinds: keys of `SUFFIXES`; None takes `DEFAULT_KINDS`.
        overwrite: make again what is there.
    """
    tasks = []
    for path in paths:
        video = is_video(path)
        wanted = tuple(kinds or DEFAULT_KINDS[video])
        task, entry = Task(path, journal.name(path), video, wanted), journal.entry(path)
        if entry and not overwrite:
            last = int(entry.get("frames", 1)) - 1
            missing = tuple(
                kind
                for kind in wanted
                if entry["made"].get(kind) != recipe(kind, weights, style) or not (out / task.file(kind, last)).is_file()
            )
            task = task._replace(kinds=missing, trouble=entry.get("trouble"))
        tasks.append(task)
    return tasks
