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
from typing import Any

import pandas as pd

from dualdepth.files import write_json, write_text
from dualdepth.run import Run, project_root

OUT = project_root() / "results" / "published" / "reliability.csv"
STAMP = ("device", "made", "version", "revision", "dirty", "lock_sha256", "python", "machine")
TESTS = "tests/reliability"
Row = dict[str, Any]


def by_pytest(*words: str, marked: str = "not soak") -> list[str]:
    """A call of pytest on files, for the tests that are so marked."""
    return ["-m", "pytest", *words, "-m", marked, "-n", "0", "-p", "no:cacheprovider", "--timeout", "0"]


# what a row of the table is called, and what Python runs
PARTS: dict[str, tuple[str, list[str]]] = {
    "kills": ("training killed by SIGKILL and started again", ["-m", "tests.reliability.kills"]),
    "chains": ("chain killed by SIGKILL and started again", ["-m", "tests.reliability.chains"]),
    "parity": ("two processes train as one, stop, die and resume", by_pytest(f"{TESTS}/test_ddp.py", marked="slow or soak")),
    "stops": ("SIGTERM: checkpoint and one line", by_pytest(f"{TESTS}/test_chains.py", "-k", "sigterm", marked="slow or soak")),
    "disk": ("full disks, closed folders, removed files", by_pytest(f"{TESTS}/test_disk.py")),
    "degenerate": ("degenerate frames and networks, finite gradients", by_pytest(f"{TESTS}/test_degenerate.py")),
    "inputs": ("bad inputs named in one line", by_pytest(f"{TESTS}/test_bad_inputs.py")),
    "fuzz": ("damaged files that crash no reader", by_pytest(TESTS, marked="fuzz")),
}


def run_part(about: str, words: list[str]) -> Row:
    """Run a part and add up what it counted, as `test`, `tried`, `held`, `note`; what went wrong is a case that did not hold. What is
    fuzzed gets 1000 examples."""
    with tempfile.TemporaryDirectory() as folder:
        counts = Path(folder) / "counts.jsonl"
        environment = os.environ | {"OMP_NUM_THREADS": "1", "DUALDEPTH_RELIABILITY": str(counts), "DUALDEPTH_EXAMPLES": "1000"}
        code = subprocess.run([sys.executable, *words], cwd=project_root(), env=environment, check=False).returncode
        rows = [json.loads(line) for line in counts.read_text(encoding="utf-8").splitlines()] if counts.exists() else []
    tried, held = (sum(row[key] for row in rows) for key in ("tried", "held"))
    note = rows[0]["note"] if "pytest" not in words and rows else f"{len(rows)} tests; {tried - held} cases went wrong"
    if not tried or (code and held == tried):
        tried, note = tried + 1, f"ended with {code} and counted too little; {note}"
    return {"test": about, "tried": tried, "held": held, "note": note}


def save(name: str, row: Row, stamp: dict[str, Any]) -> None:
    """Put a part's row into the table, and its stamp beside it."""
    path = OUT.with_suffix(".json")
    parts = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    parts[name] = {"rows": [row], **stamp}
    parts = {name: parts[name] for name in PARTS if name in parts}
    table = pd.DataFrame([row | {"device": part["device"]} for part in parts.values() for row in part["rows"]])
    write_text(OUT, table[["test", "tried", "held", "note", "device"]].to_csv(index=False))
    write_json(path, parts)


def main(argv: list[str] | None = None) -> int:
    """Run the parts that are asked for."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("parts", nargs="*", metavar="PART", choices=PARTS, help=f"of {', '.join(PARTS)}; all if none is named")
    asked = parser.parse_args(argv).parts or PARTS
    run = Run("tiny", project_root())
    run.stamp([])  # the revision before anything is written
    all_held = True
    for name in [name for name in PARTS if name in asked]:
        print(f"▶ {name}: {PARTS[name][0]}", flush=True)
        began = time.monotonic()
        row = run_part(*PARTS[name])
        seconds = round(time.monotonic() - began)
        save(name, row, {key: value for key, value in run.stamp([]).items() if key in STAMP} | {"seconds": seconds})
        holds = row["held"] == row["tried"]
        print(f"{'✓' if holds else '✗'} {row['held']} of {row['tried']}; {row['note']}; {seconds} s", flush=True)
        all_held = all_held and holds
    print(f"{OUT.relative_to(project_root())}: {'all held' if all_held else 'NOT ALL HELD'}")
    return 0 if all_held else 1


if __name__ == "__main__":
    sys.exit(main())
