"""The one error a user's mistake ends in."""

import contextlib
import sys
from collections.abc import Iterator
from typing import Any


class InputError(Exception):
    """Bad input: the message is one line that names the file, the value and the mend.

    The command line prints it and ends with exit code 2.

    >>> import dualdepth
    >>> try:
    ...     dualdepth.load("nowhere.safetensors")
    ... except dualdepth.InputError as error:
    ...     print(error)
    nowhere.safetensors: no such weights; give model.safetensors of a training, its folder, or a name on the model hub
    """


def first_mistake(error: Any) -> str:
    """Where and what the first mistake of a pydantic `ValidationError` is."""
    first = error.errors(include_url=False)[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}".removeprefix(": ")


@contextlib.contextmanager
def exit_on_input_error() -> Iterator[None]:
    """Turn an `InputError`, or a file that may not be touched, into one line on stderr and exit code 2, for commands and scripts."""
    try:
        yield
    except InputError as error:
        message = " ".join(str(error).split())
    except PermissionError as error:
        message = f"{error.filename}: {error.strerror}; change its permissions, or give another place"
    else:
        return
    print(f"error: {message}", file=sys.stderr)
    raise SystemExit(2)
