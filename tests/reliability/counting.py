"""Counts of cases for a report on reliability."""

import json
import os


def write_count(test: str, tried: int, held: int, note: str = "") -> None:
    """Append `{"test", "tried", "held", "note"}` as a line of JSON to the file that DUALDEPTH_RELIABILITY names, if it names one.

    One write to a file opened for appending: lines of tests that run side by side do not mix.
    """
    path = os.environ.get("DUALDEPTH_RELIABILITY")
    if not path:
        return
    file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o644)
    try:
        os.write(file, (json.dumps({"test": test, "tried": tried, "held": held, "note": note}) + "\n").encode())
    finally:
        os.close(file)
