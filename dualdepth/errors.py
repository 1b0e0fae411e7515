"""The one error a user's mistake ends in, and notes on assumptions that the program made."""

import contextlib
import errno
import os
import sys
from collections.abc import Iterator
from pathlib import Path

from tqdm import tqdm


class InputError(Exception):
    """Bad input: the message is one line that names the file, the value and the mend. The command line prints it and ends with code 2."""


SAID: dict[str, object] = {}
"""Notes of this process."""


def note(text: str) -> None:
    """Print one line on stderr, above any progress bar, once in a process, however many of its threads say it together."""
    if SAID.setdefault(text, mark := object()) is mark:
        tqdm.write(f"note: {text}", file=sys.stderr)


@contextlib.contextmanager
def reading(path: str | Path, mend: str) -> Iterator[None]:
    """Turn whatever the block raises into an `InputError` that names the file and the mend. For reading and parsing alone. Readers have a
    kind of exception for each damage, so all kinds are taken."""
    try:
        yield
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: no such file; {mend}") from None
    except Exception as error:
        where = getattr(error, "filename", None) or path  # the system says which folder or file may not be touched
        reason = getattr(error, "strerror", None) or f"{type(error).__name__}: {error}"  # torch's can fill a screen
        mend = "change its permissions" if isinstance(error, PermissionError) else mend
        raise InputError(f"{where}: cannot be read ({' '.join(reason.split())[:200]}); {mend}") from None


@contextlib.contextmanager
def exit_on_input_error() -> Iterator[None]:
    """Turn an `InputError`, or a file that may not be touched, into one line on stderr and exit code 2, for commands and scripts.
    Ctrl-C is one line, too, and exit code 130. A full disk for what is printed is exit code 1, a pipe that is closed early 141 without a
    line; a character that the locale lacks is printed as its number."""
    sys.stderr = sys.stderr or os.fdopen(os.open(os.devnull, os.O_WRONLY), "w")  # None where it was closed before the program began
    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            yield
        finally:
            if sys.stdout:  # which is None in a process without one
                sys.stdout.flush()
    except (InputError, PermissionError) as error:
        denied = isinstance(error, PermissionError)
        said = f"{error.filename}: {error.strerror}; change its permissions, or give another place" if denied else str(error)
        print(f"error: {' '.join(said.split())}", file=sys.stderr)
        raise SystemExit(2) from None
    except KeyboardInterrupt as stop:
        print(f"stopped; {str(stop) or 'the same command goes on where it was'}", file=sys.stderr)
        raise SystemExit(130) from None
    except OSError as error:
        if error.filename or error.errno not in (errno.EPIPE, errno.ENOSPC):
            raise
        os.dup2(os.open(os.devnull, os.O_WRONLY), 1)  # so that Python, at its end, finds nothing to complain of
        said = f"error: what is printed cannot be written ({error.strerror}); free space"
        raise SystemExit(said if error.errno == errno.ENOSPC else 141) from None
