"""The images and videos that are meant by files, folders and glob patterns."""

import glob
from collections.abc import Iterable
from pathlib import Path

from dualdepth.data.frames import IMAGES
from dualdepth.errors import InputError
from dualdepth.inference.outputs import ENDINGS

VIDEOS = (".mp4", ".avi", ".mov", ".mkv", ".webm", ".m4v", ".mpg", ".mpeg", ".wmv")


def is_video(path: Path) -> bool:
    """Whether a file is read as a video, by its ending."""
    return path.suffix.lower() in VIDEOS


def find_inputs(given: Iterable[str | Path]) -> list[Path]:
    """Files in the order given, each once.

    A file is taken whatever its ending. A folder stands for the images and videos in it (not below it), by name; a pattern
    (`*`, `?`, `[…]`, `**`) for those that match it. Of both, hidden files and results of an earlier prediction are left out.

    Raises:
        InputError: something is not there, or there are no images or videos in it.
    """
    found: dict[Path, Path] = {}
    for word in map(str, given):
        for path in _files(word):
            found.setdefault(path.resolve(), path)
    return list(found.values())


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
