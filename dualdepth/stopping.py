"""SIGTERM, a cluster's or an operator's notice: handed on to the processes that this one started, which it does not reach by itself."""

import contextlib
import os
import signal
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TextIO

import psutil


class Stop:
    """Whether SIGTERM came."""

    noted = False


@contextlib.contextmanager
def handed_on(wanted: Callable[[psutil.Process], bool], recursive: bool) -> Iterator[Stop]:
    """While the block runs, SIGTERM goes to the `wanted` children, or to all below them; the block goes on, to see them end.

    Raises:
        SystemExit: SIGTERM came and there are none.
    """
    stop = Stop()

    def hand_on(*_: object) -> None:
        stop.noted, reached = True, 0
        for child in psutil.Process().children(recursive=recursive):
            with contextlib.suppress(psutil.NoSuchProcess, ProcessLookupError):
                if wanted(child):
                    child.terminate()
                    reached += 1
        if not reached:
            raise SystemExit("stopped; run the same command to go on")

    try:
        before = signal.signal(signal.SIGTERM, hand_on)
    except ValueError:  # not the main thread: nobody can send us signals
        yield stop
        return
    try:
        yield stop
    finally:
        signal.signal(signal.SIGTERM, before)


def run_chain(command: list[str], folder: Path, lock: TextIO) -> int:
    """Run Snakemake in `folder`; it holds `lock`, too, so that it is not mixed with another run if this process is killed.

    Returns:
        Its exit code.

    Raises:
        SystemExit: SIGTERM came; Snakemake and its notebooks were told, and trainings wrote their checkpoints.
    """
    from dualdepth.lock import sign

    # kernels, in sessions of their own, are told by their notebooks
    with handed_on(lambda child: os.getpgid(child.pid) == os.getpgrp(), recursive=True) as stop:
        chain = subprocess.Popen(command, cwd=folder, pass_fds=[lock.fileno()])
        sign(lock, f", whose Snakemake is process {chain.pid}")
        try:
            code = chain.wait()
        except KeyboardInterrupt:  # Snakemake got it as well
            chain.wait()
            raise
    if stop.noted:
        raise SystemExit("stopped; run the same command to go on")
    return code
