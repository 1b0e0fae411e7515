"""Files that are either whole or absent: write under a temporary name, flush, rename."""

import contextlib
import json
import os
import re
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dualdepth.errors import InputError


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary sibling of `path`; it takes the name `path` when the block ends well.

    The suffix is kept, since image and array writers choose their format by it.
    On any exception the temporary file is removed and `path` stays as it was.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.part{path.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
        _flush_folder(path.parent)
    finally:
        partial.unlink(missing_ok=True)


def _flush_folder(folder: Path) -> None:
    """Make a rename in the folder outlive a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


_PARTIAL = re.compile(r"\..+\.[0-9a-f]{8}\.part(\.\w+)?")


def remove_leftovers(folder: str | Path, below: bool = True) -> int:
    """Remove the temporary files that killed writers left in a folder, and `below` it; for who holds its lock. Returns how many."""
    found = [path for path in Path(folder).glob("**/.*.part*" if below else ".*.part*") if _PARTIAL.fullmatch(path.name)]
    for path in found:
        path.unlink(missing_ok=True)
    return len(found)


def check_writable(folder: str | Path) -> None:
    """Make sure that files can be written into `folder`, which is made if it is not there.

    Raises:
        InputError: they cannot, and why.
    """
    probe = Path(folder) / "writable"
    try:
        with atomic_path(probe) as partial:
            partial.touch()
        probe.unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"{folder}: nothing can be written there ({error.strerror or error}); free space or change its owner") from None


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 `text` to `path` atomically."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON to `path` atomically; NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")
