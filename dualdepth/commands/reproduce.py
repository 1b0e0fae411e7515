"""`dualdepth reproduce` and `dualdepth notebook`: the chain of notebooks, and one of them."""

import argparse
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dualdepth.results import Run

ROOTS = {
    "kitti_root": "folder that holds 2011_09_26 and the other days; else what the profile needs is downloaded",
    "test_list": "frames to score instead of the profile's, in the field's format",
    "odometry_root": "folder that holds KITTI odometry's sequences and poses",
    "make3d_root": "folder that holds Make3D's Test134 and Gridlaserdata",
    "labels_root": "folder of label maps, as data_scripts/export_labels.py writes them",
}
"""Where a user's own data are: handed to notebook 01."""


def add_roots(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where the data are."""
    for name, meaning in ROOTS.items():
        kind = "FILE" if name == "test_list" else "DIR"
        parser.add_argument(f"--{name.replace('_', '-')}", default="", metavar=kind, help=meaning)
    parser.add_argument("--allow-leak", action="store_true", help="score even drives that were trained on, and mark the results")


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
    """Run the chain under a lock, so that two runs of one profile cannot mix.

    Raises:
        InputError: bad profile, seeds or paths, or a live run of the same profile.
    """
    import shutil
    import sys

    from dualdepth.atomic import remove_leftovers, write_json
    from dualdepth.errors import InputError
    from dualdepth.lock import locked
    from dualdepth.results import Run
    from dualdepth.stopping import run_chain

    run = Run(arguments.profile)
    config = chain_config(arguments, run)
    settings = [f"{k}={v}" for k, v in config.items()]
    command = [sys.executable, "-m", "snakemake", "--cores", arguments.cores, "--nolock", "--rerun-incomplete", "--quiet", "all"]
    if shutil.which("nvidia-smi"):
        command += ["--resources", "gpu=1"]  # one training at a time has the GPU to itself
    with locked(run.work / "lock") as lock:
        for folder in (run.results, run.prepared):  # a training looks after its own
            remove_leftovers(folder)
        write_json(run.given, {name: config[name] for name in (*ROOTS, "allow_leak")} | {"seeds": arguments.seeds})
        code = run_chain([*command, *arguments.snakemake, "--config", *settings], run.root, lock)
    if code:
        logs = sorted((run.root / ".snakemake" / "log").glob("*.log"))
        raise InputError(f"the chain stopped, see above; Snakemake's log is {logs[-1].relative_to(run.root) if logs else 'not there'}")
    print(f"{run.profile.name}: {run.profile.about}")
    print(f"results of profile {run.profile.name}: {run.results.relative_to(run.root)}/report.html, tables, figures, notebooks")
    return 0


def chain_config(arguments: argparse.Namespace, run: "Run", last: Mapping[str, str | int] = MappingProxyType({})) -> dict[str, str | int]:
    """What the Snakefile is told: profile, seeds, a user's own folders; what is not given is taken from `last`, what a run was given.

    Raises:
        InputError: bad seeds or paths.
    """
    from pathlib import Path

    from dualdepth.data.kitti import check_root, read_frame_list
    from dualdepth.preparation import FOLDERS

    checks = {"kitti_root": check_root, "test_list": read_frame_list, **FOLDERS}
    seeds = parse_seeds(arguments.seeds or str(last.get("seeds", ""))) or run.profile.seeds
    profile = str(Path(arguments.profile).resolve()) if Path(arguments.profile).is_file() else arguments.profile
    config: dict[str, str | int] = {"profile": profile, "seeds": ",".join(map(str, seeds))}
    for name in ROOTS:
        given = getattr(arguments, name)
        if given:
            checks[name](given)
        config[name] = str(Path(given).resolve()) if given else last.get(name, "")
    return config | {"allow_leak": int(arguments.allow_leak or last.get("allow_leak", 0))}


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


def parse_seeds(text: str) -> list[int]:
    """Seeds of `0,1,2`; none of an empty text.

    Raises:
        InputError: something else than whole numbers from 0 up between commas.
    """
    from dualdepth.errors import InputError

    try:
        seeds = [int(part) for part in text.split(",")] if text else []
    except ValueError:
        seeds = [-1]
    if any(seed < 0 for seed in seeds):
        raise InputError(f"seeds {text!r}: give whole numbers from 0 up between commas, such as 0,1,2")
    return seeds
