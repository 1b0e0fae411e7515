"""The long form of the tests of reliability, counted in `results/published/reliability.csv`.

    python -m tests.reliability.soak                  # all parts
    python -m tests.reliability.soak kills chains     # some; the rows of the others stay

A part is a process of its own, which appends its counts to a file. One that fails, or counts nothing, is a row that did not hold, and the
next goes on. Beside the table lies `reliability.json`, with each part's stamp.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any, NamedTuple

import pandas as pd

from dualdepth.files import write_json, write_text
from dualdepth.run import Run, project_root

OUT = project_root() / "results" / "published" / "reliability.csv"
STAMP = ("device", "made", "version", "revision", "dirty", "lock_sha256", "python", "machine")
TESTS = "tests/reliability"
Row = dict[str, Any]


class Part(NamedTuple):
    """One command of the soak."""

    about: str
    """The row of a part that counts by its tests; else what is said while it runs."""
    words: list[str]
    """What Python runs."""
    examples: str = ""
    """DUALDEPTH_EXAMPLES, how much is fuzzed."""


def by_pytest(*words: str, marked: str = "not soak") -> list[str]:
    """A call of pytest on files, for the tests that are so marked."""
    return ["-m", "pytest", *words, "-m", marked, "-n", "0", "-p", "no:cacheprovider", "--timeout", "0"]


PARTS = {
    "kills": Part("trainings killed", ["-m", "tests.reliability.kills", "--kills", "50"]),
    "chains": Part("chains killed", ["-m", "tests.reliability.chains", "--kills", "20"]),
    "parity": Part("two processes against one", ["-m", "tests.reliability.ddp"]),
    "ranks": Part("tests of several processes that stop, die, share and resume", by_pytest(f"{TESTS}/test_ddp.py")),
    "stops": Part("SIGTERM: checkpoint and one line", by_pytest(f"{TESTS}/test_stopping.py", marked="slow or soak")),
    "disk": Part("full disks, closed folders, removed files", by_pytest(f"{TESTS}/test_disk.py")),
    "degenerate": Part("degenerate frames and networks, finite gradients", by_pytest(f"{TESTS}/test_degenerate.py")),
    "inputs": Part("bad inputs named in one line", by_pytest(f"{TESTS}/test_bad_inputs.py", f"{TESTS}/test_permissions.py")),
    "fuzz": Part("damaged files that crash no reader", by_pytest(TESTS, marked="fuzz"), examples="1000"),
}


def run_part(name: str, part: Part) -> list[Row]:
    """Run a part and read what it counted.

    Returns:
        Rows with `test`, `tried`, `held`, `note`; what went wrong is one that did not hold.
    """
    with tempfile.TemporaryDirectory() as folder:
        counts = Path(folder) / "counts.jsonl"
        environment = os.environ | {"OMP_NUM_THREADS": "1", "DUALDEPTH_RELIABILITY": str(counts)}
        environment |= {"DUALDEPTH_EXAMPLES": part.examples} if part.examples else {}
        code = subprocess.run([sys.executable, *part.words], cwd=project_root(), env=environment, check=False).returncode
        rows = [json.loads(line) for line in counts.read_text(encoding="utf-8").splitlines()] if counts.exists() else []
        if "pytest" in part.words:
            tried, held = (sum(row[key] for row in rows) for key in ("tried", "held"))
            rows = [{"test": part.about, "tried": tried, "held": held, "note": f"{len(rows)} tests; {tried - held} cases went wrong"}]
    failed = code != 0 and all(row["held"] == row["tried"] for row in rows)
    if failed or not sum(row["tried"] for row in rows):
        rows.append({"test": part.about, "tried": 1, "held": 0, "note": f"part {name} ended with {code} and counted too little"})
    return rows


def save(name: str, rows: list[Row], stamp: dict[str, Any]) -> None:
    """Put a part's rows into the table, and its stamp beside it."""
    path = OUT.with_suffix(".json")
    parts = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    parts[name] = {"rows": rows, **stamp}
    parts = {name: parts[name] for name in PARTS if name in parts}
    table = pd.DataFrame([row | {"device": part["device"]} for part in parts.values() for row in part["rows"]])
    write_text(OUT, table[["test", "tried", "held", "note", "device"]].to_csv(index=False))
    write_json(path, parts)


def main(argv: list[str] | None = None) -> int:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)}; all if none is named")
    arguments = parser.parse_args(argv)
    if unknown := sorted(set(arguments.parts) - set(PARTS)):
        parser.error(f"unknown part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    run = Run("tiny", project_root())
    run.stamp([])  # the revision before anything is written
    held = True
    for name in [name for name in PARTS if not arguments.parts or name in arguments.parts]:
        print(f"▶ {name}: {PARTS[name].about}", flush=True)
        began = time.monotonic()
        rows = run_part(name, PARTS[name])
        seconds = round(time.monotonic() - began)
        save(name, rows, {key: value for key, value in run.stamp([]).items() if key in STAMP} | {"seconds": seconds})
        for row in rows:
            print(
                f"{'✓' if row['held'] == row['tried'] else '✗'} {row['test']}: {row['held']} of {row['tried']}; {row['note']}", flush=True
            )
        held = held and all(row["held"] == row["tried"] for row in rows)
        print(f"  {seconds} s", flush=True)
    print(f"{OUT.relative_to(project_root())}: {'all held' if held else 'NOT ALL HELD'}")
    return 0 if held else 1


if __name__ == "__main__":
    sys.exit(main())
