"""The one error a user's mistake ends in."""

import contextlib
import sys
from collections.abc import Iterator


class InputError(Exception):
    """Bad input: the message is one line that names the file, the value and the mend."""


@contextlib.contextmanager
def exit_on_input_error() -> Iterator[None]:
    """Turn an `InputError` into one line on stderr and exit code 2, for commands and scripts."""
    try:
        yield
    except InputError as error:
        message = " ".join(str(error).split())
        print(f"error: {message}", file=sys.stderr)
        raise SystemExit(2) from None
