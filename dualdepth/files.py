"""Files that are either whole or absent (write under a temporary name, flush, rename), their digests, and locks."""

import contextlib
import hashlib
import json
import os
import re
import socket
import tempfile
import uuid
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from dualdepth.errors import InputError


@contextlib.contextmanager
def atomic_path(path: str | Path) -> Iterator[Path]:
    """Give a temporary sibling of `path`; it takes the name `path` when the block ends well.

    The suffix is kept, since image and array writers choose their format by it. On any exception the temporary file is removed and `path`
    stays as it was. The file that a symbolic link names is replaced, not the link; a device or a pipe is given itself.
    """
    path = Path(path)
    if path.is_char_device() or path.is_fifo():
        yield path
        return
    path = Path(os.path.realpath(path))
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.stem}.{uuid.uuid4().hex[:8]}.part{path.suffix}")
    try:
        yield partial
        with open(partial, "rb+") as file:
            os.fsync(file.fileno())
        os.replace(partial, path)
        with contextlib.suppress(OSError):  # not every system lets a folder be opened
            folder = os.open(path.parent, os.O_RDONLY)
            os.fsync(folder)  # so that the new name outlives a power cut
            os.close(folder)
    finally:
        partial.unlink(missing_ok=True)


_PARTIAL = re.compile(r"\..+\.[0-9a-f]{8}\.part(\.\w+)?")


def remove_leftovers(folder: str | Path, below: bool = True) -> None:
    """Remove the temporary files that killed writers left in a folder, and `below` it. Call it only while holding the folder's lock."""
    for path in list(Path(folder).glob("**/.*.part*" if below else ".*.part*")):
        if _PARTIAL.fullmatch(path.name):
            path.unlink(missing_ok=True)


def check_writable(folder: str | Path) -> None:
    """Make sure that files can be written into `folder`, which is made if it is not there; an `InputError` says why they cannot."""
    try:
        Path(folder).mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=folder).close()
    except OSError as error:
        raise InputError(f"{folder}: nothing can be written there ({error.strerror or error}); free space or change its owner") from None


def write_text(path: str | Path, text: str) -> None:
    """Write UTF-8 `text` to `path` atomically."""
    with atomic_path(path) as partial:
        partial.write_text(text, encoding="utf-8")


def write_json(path: str | Path, value: Any) -> None:
    """Write `value` as indented JSON to `path` atomically; NaN and infinity are refused."""
    write_text(path, json.dumps(value, indent=1, allow_nan=False, ensure_ascii=False) + "\n")


def short_digest(*parts: str) -> str:
    """The first 16 hex digits of the parts' sha256."""
    return hashlib.sha256(" ".join(parts).encode("utf-8", "surrogateescape")).hexdigest()[:16]


def file_digest(path: Path) -> str | None:
    """sha256 of a file, or None where there is none."""
    if not path.is_file():
        return None
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def folder_digest(folder: str | Path, *patterns: str) -> str:
    """Digest of names, sizes and times of files below a folder, to notice cheaply that they were replaced; of nothing for no folder."""
    files = sorted(path for pattern in patterns for path in Path(folder).glob(pattern)) if folder else []
    return short_digest(*(f"{path.name} {path.stat().st_size} {path.stat().st_mtime_ns}" for path in files))


@contextlib.contextmanager
def locked(path: str | Path, patience: float = 0.0, *, inherited: bool = False) -> Iterator[None]:
    """Hold the lock file `path`, whose folder is made and which says who holds it. The system releases it when the process ends, however it
    ends; while a live process holds it, an `InputError` says which, after `patience` seconds for a holder that may be ending. `inherited`:
    the program that this process becomes (`os.exec…`) holds it, too.
    """
    from filelock import FileLock, Timeout

    def write_owner(descriptor: int) -> None:
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, f"process {os.getpid()} on {socket.gethostname()}".encode(), 0)
        os.set_inheritable(descriptor, inherited)

    try:
        held = FileLock(path, timeout=patience, on_acquired=write_owner).acquire()
    except Timeout:
        holder = Path(path).read_text(encoding="utf-8").strip() or "another run"
        raise InputError(f"{path}: held by {holder}; wait for it or stop it") from None
    with held:
        yield
