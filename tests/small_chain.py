"""The chain of a small profile in a folder of its own, with a stand-in for the command that runs a notebook."""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

from dualdepth.run import project_root

STAND_IN = """#!{python}
import pathlib, re, sys
words = " ".join(sys.argv)
out = pathlib.Path(sys.argv[sys.argv.index("--out") + 1])
name, profile = sys.argv[2], out.parts[1]
seed, variant = (re.search(key + r"=(\\S+)", words) for key in ("seed", "variant"))
table = name.partition("table_")[2]
made = {{
    "14_report": ["results/{{p}}/report.html"],
    "01_download_data": ["work/{{p}}/sources.json"],
    "02_prepare_data": ["work/{{p}}/prepared/" + n for n in (
        "triplets.csv", "identity.json", "test_frames.json", "ground_truth.npz", "odometry.csv")],
    "03_train_lr": ["work/{{p}}/runs/{{v}}/seed{{s}}/trained.json"],
    "04_train_hr": ["work/{{p}}/runs/{{v}}/seed{{s}}/trained.json"],
}}.get(name, ["results/{{p}}/tables/" + table + end for end in (".csv", ".json")] if table else [])
for path in [out, *(pathlib.Path(m.format(p=profile, s=seed and seed[1], v=variant and variant[1])) for m in made)]:
    path.parent.mkdir(parents=True, exist_ok=True)
    said = "method,source,abs_rel,a1" if path.name == "main.csv" else words
    path.write_text(said)
with open("ran.txt", "a") as log:
    log.write(" ".join([name, *([variant[1], "seed", seed[1]] if variant else [])]) + "\\n")
"""
PROFILE = """about: a test
world: {}
data: {source: miniature}
training: {encoder: resnet18}
train: {lr: , dual: , resnet18: }
"""


class SmallChain:
    """The checkout's Snakefile and notebooks, copied to `root`, with a profile that can be changed."""

    def __init__(self, root: Path) -> None:
        self.root = root
        self.profile = root / "own.yaml"
        self.environment = os.environ | {"PATH": f"{root / 'bin'}:{os.environ['PATH']}", "PYTHONPATH": str(project_root())}

    @classmethod
    def make(cls, root: Path) -> "SmallChain":
        for name in ("Snakefile", "notebooks"):
            source = project_root() / name
            (shutil.copytree if source.is_dir() else shutil.copyfile)(source, root / name)
        command = root / "bin" / "dualdepth"
        command.parent.mkdir()
        command.write_text(STAND_IN.format(python=sys.executable))
        command.chmod(0o755)
        (root / "own.yaml").write_text(PROFILE)
        return cls(root)

    def copy(self, root: Path) -> "SmallChain":
        """All of it, with what it has made."""
        shutil.copytree(self.root, root, symlinks=True, dirs_exist_ok=True)
        return SmallChain(root)

    def change(self, before: str, after: str) -> None:
        """Put other words into the profile."""
        text = self.profile.read_text()
        assert before in text
        self.profile.write_text(text.replace(before, after))

    def ran(self) -> list[str]:
        """Notebooks that the last run ran."""
        file = self.root / "ran.txt"
        return sorted(file.read_text().splitlines()) if file.exists() else []

    def __call__(self, *config: str, change: tuple[str, str] | None = None) -> list[str]:
        """Run the chain, after a change of the profile, and say which notebooks ran."""
        if change:
            self.change(*change)
        (self.root / "ran.txt").unlink(missing_ok=True)
        words = [sys.executable, "-m", "snakemake", "--cores", "2", "--nolock", "--config", f"profile={self.profile}", *config]
        done = subprocess.run(words, cwd=self.root, env=self.environment, capture_output=True, text=True, check=False)
        assert done.returncode == 0, done.stderr
        return self.ran()

    def reproduce(self, *words: str) -> subprocess.CompletedProcess[str]:
        """The command that a user gives."""
        command = [sys.executable, "-m", "dualdepth.cli", "reproduce", "--profile", str(self.profile), *words]
        return subprocess.run(command, cwd=self.root, env=self.environment, capture_output=True, text=True, check=False)

    def would_run(self) -> dict[str, str]:
        """Why, by rule, of a dry run."""
        done = self.reproduce("--", "--dry-run")
        assert done.returncode == 0 and done.stderr == "", done.stderr
        rules = re.findall(r"^(?:local)?rule (\S+):\n(?:    .*\n)*?    reason: (.*)$", done.stdout, re.MULTILINE)
        return {name: reason for name, reason in rules if name != "all"}
