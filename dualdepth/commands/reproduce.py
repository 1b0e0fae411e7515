"""`dualdepth reproduce`, `notebook` and `train`: the chain of notebooks, one of them, and one training by hand or under SLURM."""

import argparse
import os
import re
import shutil
import sys
from contextlib import nullcontext
from pathlib import Path

from dualdepth.errors import InputError
from dualdepth.files import check_writable, locked, remove_leftovers
from dualdepth.notebooks import run_notebook
from dualdepth.run import ROOTS, Run, add_roots, check_roots, parse_seeds

DRY = re.compile(r"--dry-?run|-[a-z]*n[a-z]*")
"""Snakemake's options for only saying what it would run, such as `-np`."""


def add_reproduce(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `reproduce`."""
    parser = commands.add_parser("reproduce", help="run all notebooks of a profile in order, and only what is not done yet")
    parser.add_argument("--profile", default="miniature", help="tiny, miniature, sample, paper, own, or a YAML file (default: %(default)s)")
    add_roots(parser)
    parser.add_argument("--seeds", default="", metavar="0,1,2", help="seeds to train instead of the profile's")
    parser.add_argument("--cores", default="all", help="cores Snakemake may use (default: %(default)s)")
    parser.add_argument("snakemake", nargs="*", metavar="-- OPTION", help="after --: options for Snakemake, such as --executor slurm")
    parser.set_defaults(run=_reproduce)


def add_notebook(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `notebook`."""
    parser = commands.add_parser("notebook", help="run one notebook by papermill")
    parser.add_argument("name", help="such as 03_train_lr")
    parser.add_argument("--out", required=True, metavar="FILE", help="where the executed copy goes")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="the notebook's parameters")
    parser.set_defaults(run=_notebook)


def add_train(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `train`."""
    parser = commands.add_parser("train", help="train one variant of a profile, or go on with it")
    parser.add_argument("--profile", default="miniature", help="tiny, miniature, sample, paper, own, or a YAML file (default: %(default)s)")
    parser.add_argument("--variant", default="lr", help="which network (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of initialisation, order and augmentation (default: %(default)s)")
    parser.set_defaults(run=_train)


def _reproduce(arguments: argparse.Namespace) -> int:
    """Become Snakemake, which runs the chain under a lock, so that two runs of one profile cannot mix; a dry run needs none."""
    run, dry = Run(arguments.profile), any(map(DRY.fullmatch, arguments.snakemake))
    command = _snakemake_command(arguments, run.profile.seeds, ["host", "progress"] if dry else ["all"])
    check_writable(run.root / ".snakemake")  # of which Snakemake, being quiet, would not say a word
    with nullcontext() if dry else locked(run.work / "lock", inherited=True):
        for folder in () if dry else (run.results, run.prepared):  # a training looks after its own
            remove_leftovers(folder)
        print(f"profile {run.profile.name}: {run.profile.about}; results in {run.results.relative_to(run.root)}", flush=True)
        os.chdir(run.root)
        os.execv(sys.executable, command)


def _snakemake_command(arguments: argparse.Namespace, usual_seeds: list[int], quiet: list[str]) -> list[str]:
    """The words that start Snakemake; `quiet` is what it shall not speak of."""
    given = {name: getattr(arguments, name) for name in ROOTS}
    check_roots(given)
    config = {
        "profile": str(Path(arguments.profile).resolve()) if Path(arguments.profile).is_file() else arguments.profile,
        "seeds": ",".join(map(str, parse_seeds(arguments.seeds) or usual_seeds)),
        **{name: str(Path(value).resolve()) if value else "" for name, value in given.items()},
        "allow_leak": int(arguments.allow_leak),
    }
    command = [sys.executable, "-m", "snakemake", "--cores", arguments.cores, "--nolock", "--rerun-incomplete", "--quiet", *quiet]
    if shutil.which("nvidia-smi"):
        command += ["--resources", "gpu=1"]  # one training at a time has the GPU to itself
    return [*command, *arguments.snakemake, "--config", *(f"{k}={v}" for k, v in config.items())]


def _notebook(arguments: argparse.Namespace) -> int:
    run_notebook(arguments.name, arguments.out, parse_parameters(arguments.set))
    return 0


def parse_parameters(pairs: list[str]) -> dict[str, int | str]:
    """Parameters of `KEY=VALUE` words: whole numbers as such, all else as text, which nothing evaluates.

    Raises:
        InputError: a word without `=`.
    """
    parameters: dict[str, int | str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"parameter {pair!r} is not KEY=VALUE")
        parameters[key] = int(value) if re.fullmatch("-?[0-9]{1,18}", value) else value
    return parameters


def _train(arguments: argparse.Namespace) -> int:
    """Train and say where the weights are."""
    from dualdepth.device import is_main_process
    from dualdepth.training.variants import train_variant

    if not 0 <= arguments.seed < 2**32:
        raise InputError(f"--seed {arguments.seed}: give a whole number from 0 to 4294967295")
    weights = train_variant(Run(arguments.profile), arguments.variant, arguments.seed)
    if is_main_process():
        print(weights)
    return 0
