"""Counts of cases for a report on reliability."""

import argparse
import json
import os
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple


class Tally(NamedTuple):
    """What became of the kills of one training, or of one chain."""

    kills: int
    special: int
    """Those that the report counts apart."""
    wrong: list[str]
    """What was not as without kills."""


def write_count(test: str, tried: int, held: int, note: str = "") -> None:
    """Append `{"test", "tried", "held", "note"}` as a line of JSON to the file that DUALDEPTH_RELIABILITY names, if it names one: by one
    write to a file opened for appending, so that lines of tests that run side by side do not mix."""
    if path := os.environ.get("DUALDEPTH_RELIABILITY"):
        with open(path, "ab", buffering=0) as file:
            file.write((json.dumps({"test": test, "tried": tried, "held": held, "note": note}) + "\n").encode())


def until_killed(kills: int, each: int, kill_one: Callable[[int, int], Tally]) -> list[Tally]:
    """Kill one after the other by `kill_one(number, kills)`, with at most `each` kills of one, until there were `kills`."""
    tallies = []
    while (left := kills - sum(tally.kills for tally in tallies)) > 0:
        tallies.append(kill_one(len(tallies), min(each, left)))
        print(f"  {kills - left + tallies[-1].kills} of {kills} kills, {'; '.join(tallies[-1].wrong) or 'the same'}", flush=True)
    return tallies


def count_kills(try_kills: Callable[[Path, int, int], list[Tally]], note: str, kills: int, each: int) -> int:
    """Kill by `try_kills`, in a folder, as often as the command line asks, or else `kills` in all and `each` of one that runs; and count.
    `note` is for the report, with the number of special kills at its {}."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--kills", type=int, default=kills)
    parser.add_argument("--each", type=int, default=each, help="kills of one, at most")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as root:
        tallies = try_kills(Path(root), arguments.kills, arguments.each)
    tried, held = sum(tally.kills for tally in tallies), sum(tally.kills for tally in tallies if not tally.wrong)
    note = f"{len(tallies)} {note.format(sum(tally.special for tally in tallies))}"
    write_count("kills", tried, held, note)
    print(f"{held} of {tried} kills harmless: {note}")
    return 0 if held == tried else 1
