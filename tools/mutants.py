"""Break lines of the science one at a time, and see that the tests notice each.

    python -m tools.mutants [WORDS]    # all, or those whose description has the words

`mutants.yaml` lists them: what a line is for, its file below `dualdepth/`, words that stand there once, what they become, and the test
files below `tests/` of which one must fail.
"""

import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import yaml

from dualdepth.run import project_root


def failing(root: Path, file: str, old: str, new: str, tests: list[str], **_: str) -> str:
    """The first test that fails with a line broken, in a copy of the checkout; nothing if none does."""
    path = root / "dualdepth" / file
    whole = path.read_text(encoding="utf-8")
    if whole.count(old) != 1:
        raise ValueError(f"{old!r} stands {whole.count(old)} times in {file}; mend tools/mutants.yaml")
    path.write_text(whole.replace(old, new), encoding="utf-8")
    options = ["-x", "-q", "-rfE", "-n", "0", "-m", "not soak", "-p", "no:cacheprovider"]
    words = ["-m", "pytest", *options, *(f"tests/{name}" for name in tests)]
    environment = os.environ | {"PYTHONPATH": str(root), "PYTHONDONTWRITEBYTECODE": "1"}
    done = subprocess.run([sys.executable, *words], cwd=root, env=environment, capture_output=True, text=True, check=False)
    path.write_text(whole, encoding="utf-8")
    return next((line.split()[1] for line in done.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))), "")


def main(words: str = "") -> int:
    """Try them; 1 if one escapes."""
    listed = yaml.safe_load(Path(__file__).with_suffix(".yaml").read_text(encoding="utf-8"))
    mutants, noticed = [mutant for mutant in listed if words in mutant["what"]], 0
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / "checkout"
        shutil.copytree(project_root(), root, ignore=shutil.ignore_patterns(".git", ".venv", ".snakemake", "work", "results"))
        for mutant in mutants:
            test = failing(root, **mutant)
            noticed += bool(test)
            print(f"{'✓' if test else '✗'} {mutant['what']} ({mutant['file']}): {test or 'no test failed'}", flush=True)
    print(f"{noticed} of {len(mutants)} broken lines were noticed")
    return 0 if noticed == len(mutants) else 1


if __name__ == "__main__":
    sys.exit(main(" ".join(sys.argv[1:])))
