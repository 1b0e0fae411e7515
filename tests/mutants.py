"""Break lines of the science one at a time, and see that the tests notice each.

    python -m tests.mutants [WORDS]    # or those whose description has the words

`mutants.yaml` is the list. Each is tried in a copy of the checkout, with the tests that should fail.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import NamedTuple

import yaml

from dualdepth.run import project_root


class Mutant(NamedTuple):
    """A broken line."""

    what: str
    """The line's task."""
    file: str
    """Below `dualdepth/`."""
    old: str
    """Words that stand once in the file."""
    new: str
    """What they become."""
    tests: list[str]
    """Files below `tests/`, one of which must fail."""


def listed() -> list[Mutant]:
    """All of them, each with its words once in its file.

    Raises:
        ValueError: a line has changed, so the list must.
    """
    mutants = [Mutant(**entry) for entry in yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))]
    for mutant in mutants:
        found = (project_root() / "dualdepth" / mutant.file).read_text(encoding="utf-8").count(mutant.old)
        if found != 1:
            raise ValueError(f"{mutant.what}: {mutant.old!r} stands {found} times in {mutant.file}; mend tests/mutants.yaml")
    return mutants


def failing(root: Path, mutant: Mutant) -> str:
    """The first test that fails with this line broken; nothing if none does."""
    path = root / "dualdepth" / mutant.file
    whole = path.read_text(encoding="utf-8")
    path.write_text(whole.replace(mutant.old, mutant.new), encoding="utf-8")
    words = ["-m", "pytest", "-x", "-q", "-rfE", "-p", "no:cacheprovider", *(f"tests/{name}" for name in mutant.tests)]
    environment = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    try:
        done = subprocess.run([sys.executable, *words], cwd=root, env=environment, capture_output=True, text=True, check=False)
    finally:
        path.write_text(whole, encoding="utf-8")
    return next((line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))), "")


def main(words: str = "") -> int:
    """Try all; 1 if one escapes."""
    mutants, escaped = [mutant for mutant in listed() if words in mutant.what], []
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "checkout"
        shutil.copytree(project_root(), root, ignore=shutil.ignore_patterns(".git", ".venv", ".snakemake", "work", "results"))
        for mutant in mutants:
            test = failing(root, mutant)
            print(f"{'✓' if test else '✗'} {mutant.what} ({mutant.file}): {test or 'no test failed'}", flush=True)
            escaped += [] if test else [mutant.what]
    print(f"{len(mutants) - len(escaped)} of {len(mutants)} broken lines were noticed" + "".join(f"; not {what}" for what in escaped))
    return 1 if escaped else 0


if __name__ == "__main__":
    sys.exit(main(" ".join(sys.argv[1:])))
