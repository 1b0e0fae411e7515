"""`dualdepth replay`: the batch whose loss or gradient was not finite, computed again."""

import argparse


def add_replay(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `replay`."""
    parser = commands.add_parser("replay", help="compute again the batch at which a training stopped for numbers that are not finite")
    parser.add_argument("failure", metavar="FILE", help="work/<profile>/runs/<variant>/seed<n>/failure.pt")
    parser.add_argument("--profile", default="", help="of that training, if it is not the one that the path names")
    parser.set_defaults(run=replay)


def replay(arguments: argparse.Namespace) -> int:
    """Say where the numbers stop being finite.

    Raises:
        InputError: the file cannot be read, or is not where a training of a known profile writes it.
    """
    from pathlib import Path

    from dualdepth import faults
    from dualdepth.building import make_stage
    from dualdepth.errors import InputError
    from dualdepth.results import Run
    from dualdepth.trainings import start_weights

    path = Path(arguments.failure).resolve()
    state = faults.load_failure(path)
    folder = path.parent
    if not (folder.name.startswith("seed") and folder.name[4:].isdigit() and folder.parent.parent.name == "runs"):
        raise InputError(f"{path}: is not inside work/<profile>/runs/<variant>/seed<n>; leave it where the training wrote it")
    run = Run(arguments.profile or folder.parents[2].name)
    name = folder.parent.name
    variant, profile = run.profile.variant(name), run.profile.of_variant(name)
    stage = make_stage(profile, variant, start_weights(run, variant, int(folder.name[4:])))
    print("\n".join(faults.replay(state, stage)))
    return 0
