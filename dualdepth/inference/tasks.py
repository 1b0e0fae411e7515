"""What is left to do for each input: results that are there and were made the same way are not made again."""

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

from dualdepth.inference.inputs import is_video
from dualdepth.inference.journal import Journal
from dualdepth.inference.outputs import SIDE_VIDEO, SUFFIXES, Style

DEFAULT_KINDS = {False: ("colour", "depth"), True: ("side",)}
"""What is made of images (False) and videos (True) where nothing else is asked for."""


class Task(NamedTuple):
    """One input and what is to be made of it."""

    path: Path
    name: str
    """Of its results."""
    video: bool
    kinds: tuple[str, ...]
    """That are missing; none where all are there."""
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
    """A task for each input, in their order.

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
