"""One run of a profile at a time, and one process a training; the lock of a dead run is none."""

import contextlib
import fcntl
import os
import socket
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from dualdepth.errors import InputError


@contextlib.contextmanager
def locked(path: str | Path, patience: float = 0.0) -> Iterator[TextIO]:
    """Hold the lock file `path`; the system lets go of it when the process ends, however it ends.

    A process that is handed the file (`pass_fds`) holds the lock, too, and so do forked ones.

    Args:
        path: of the lock file; its folder is made.
        patience: seconds to wait for a holder that may be ending.

    Raises:
        InputError: a live process holds it; the message says which.
    """
    path, until = Path(path), time.monotonic() + patience
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("a+", encoding="utf-8") as file:
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() >= until:
                    file.seek(0)
                    raise InputError(f"{path}: held by {file.read().strip() or 'another run'}; wait for it or stop it") from None
            time.sleep(0.1)
        sign(file)
        yield file


def sign(file: TextIO, more: str = "") -> None:
    """Write into a lock file that is held who holds it, and `more` about it."""
    file.seek(0)
    file.truncate()
    file.write(f"process {os.getpid()} on {socket.gethostname()}{more}")
    file.flush()


def holder(path: str | Path) -> str | None:
    """The live process that holds the lock file `path`, such as `process 123 on host`; None where none does."""
    try:
        with Path(path).open(encoding="utf-8") as file:
            try:
                fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return file.read().strip() or "another run"
    except FileNotFoundError:
        pass
    return None
