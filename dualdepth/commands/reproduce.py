"""`dualdepth reproduce` and `dualdepth notebook`: the chain of notebooks, and one of them."""

import argparse

from dualdepth.run import ROOTS, add_roots, check_roots, parse_seeds


def add_reproduce(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `reproduce`."""
    parser = commands.add_parser("reproduce", help="run all notebooks of a profile in order, and only what is not done yet")
    parser.add_argument("--profile", default="tiny", help="tiny, miniature, sample, paper, own, or a YAML file (default: %(default)s)")
    add_roots(parser)
    parser.add_argument("--seeds", default="", metavar="0,1,2", help="seeds to train instead of the profile's")
    parser.add_argument("--cores", default="all", help="cores Snakemake may use (default: %(default)s)")
    parser.add_argument("snakemake", nargs="*", metavar="-- OPTION", help="after --: options for Snakemake, such as --executor slurm")
    parser.set_defaults(run=reproduce)


def add_notebook(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `notebook`."""
    parser = commands.add_parser("notebook", help="run one notebook by papermill")
    parser.add_argument("name", help="such as 03_train_lr")
    parser.add_argument("--out", required=True, metavar="FILE", help="where the executed copy goes")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="the notebook's parameters")
    parser.set_defaults(run=notebook)


def reproduce(arguments: argparse.Namespace) -> int:
    """Become Snakemake, which runs the chain under a lock, so that two runs of one profile cannot mix.

    Raises:
        InputError: bad profile, seeds or paths, or a live run of the same profile.
    """
    import os
    import shutil
    import sys
    from pathlib import Path

    from dualdepth.files import locked, remove_leftovers
    from dualdepth.run import Run

    run = Run(arguments.profile)
    seeds = parse_seeds(arguments.seeds) or run.profile.seeds
    given = {name: getattr(arguments, name) for name in ROOTS}
    check_roots(given)
    config = {
        "profile": str(Path(arguments.profile).resolve()) if Path(arguments.profile).is_file() else arguments.profile,
        "seeds": ",".join(map(str, seeds)),
        **{name: str(Path(value).resolve()) if value else "" for name, value in given.items()},
        "allow_leak": int(arguments.allow_leak),
    }
    command = [sys.executable, "-m", "snakemake", "--cores", arguments.cores, "--nolock", "--rerun-incomplete", "--quiet", "all"]
    if shutil.which("nvidia-smi"):
        command += ["--resources", "gpu=1"]  # one training at a time has the GPU to itself
    command += [*arguments.snakemake, "--config", *(f"{k}={v}" for k, v in config.items())]
    with locked(run.work / "lock", inherited=True):
        for folder in (run.results, run.prepared):  # a training looks after its own
            remove_leftovers(folder)
        sys.stdout.flush()
        os.chdir(run.root)
        os.execv(sys.executable, command)


def notebook(arguments: argparse.Namespace) -> int:
    """Run one notebook.

    Raises:
        InputError: a malformed or unknown parameter, or an error inside that a user can mend.
    """
    from dualdepth.notebooks import run_notebook

    run_notebook(arguments.name, arguments.out, parse_parameters(arguments.set))
    return 0


def parse_parameters(pairs: list[str]) -> dict[str, int | str]:
    """Parameters of `KEY=VALUE` words: whole numbers as such, all else as text, which nothing evaluates.

    Raises:
        InputError: a word without `=`.
    """
    import re

    from dualdepth.errors import InputError

    parameters: dict[str, int | str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"parameter {pair!r} is not KEY=VALUE")
        parameters[key] = int(value) if re.fullmatch("-?[0-9]{1,18}", value) else value
    return parameters
