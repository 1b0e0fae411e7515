"""Counts of cases for a report on reliability."""

import argparse
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path


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


def count_kills(test: str, kills: int, each: int, try_kills: Callable[[Path, int, int], tuple[list[int], int, str]]) -> int:
    """Kill as often as the command line asks and count.

    Args:
        test: the row of the report.
        kills, each: how often, and how often at most one that runs, unless the command line says otherwise.
        try_kills: gives how many kills were tried, one number a thing that was killed; how many of all were harmless; a note.
    """
    parser = argparse.ArgumentParser(description=test)
    parser.add_argument("--kills", type=int, default=kills)
    parser.add_argument("--each", type=int, default=each, help="kills of one, at most")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as root:
        tried, held, note = try_kills(Path(root), arguments.kills, arguments.each)
    write_count(test, sum(tried), held, f"{len(tried)} {note}")
    print(f"{held} of {sum(tried)} kills harmless: {len(tried)} {note}")
    return 0 if held == sum(tried) else 1
