"""`dualdepth train`: one training of a profile, by hand or under `torchrun` and SLURM."""

import argparse


def add_train(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `train`."""
    parser = commands.add_parser("train", help="train one variant of a profile, or go on with it")
    parser.add_argument("--profile", default="tiny", help="tiny, miniature, sample, paper, own, or a YAML file (default: %(default)s)")
    parser.add_argument("--variant", default="lr", help="which network (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of initialisation, order and augmentation (default: %(default)s)")
    parser.set_defaults(run=train)


def train(arguments: argparse.Namespace) -> int:
    """Train and say where the weights are.

    Raises:
        InputError: a negative seed, or what `train_variant` says.
    """
    from dualdepth.device import is_main_process
    from dualdepth.errors import InputError
    from dualdepth.run import Run
    from dualdepth.training.variants import train_variant

    if not 0 <= arguments.seed < 2**32:
        raise InputError(f"--seed {arguments.seed}: give a whole number from 0 to 4294967295")
    weights = train_variant(Run(arguments.profile), arguments.variant, arguments.seed)
    if is_main_process():
        print(weights)
    return 0
