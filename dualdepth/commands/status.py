"""`dualdepth status`: where the chain of a profile stands."""

import argparse

from dualdepth.commands.reproduce import add_roots, chain_config


def add_status(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `status`."""
    parser = commands.add_parser("status", help="which steps of a profile are done, stale (and why), missing or running")
    parser.add_argument("--profile", default="tiny", help="tiny, miniature, sample, paper, own, or a YAML file (default: %(default)s)")
    add_roots(parser)
    parser.add_argument("--seeds", default="", metavar="0,1,2", help="as given to reproduce; what is not given is taken from its last run")
    parser.set_defaults(run=status)


def status(arguments: argparse.Namespace) -> int:
    """Print a line a step and a line of counts.

    Raises:
        InputError: bad profile, seeds or paths.
    """
    import json

    from dualdepth.lock import holder
    from dualdepth.results import Run
    from dualdepth.status import STATES, chain_steps

    run = Run(arguments.profile)
    last = json.loads(run.given.read_text(encoding="utf-8")) if run.given.exists() else {}
    steps = chain_steps(run, chain_config(arguments, run, last))
    width = max(len(step.name) for step in steps)
    for step in steps:
        print(f"{step.state:<8} {step.name:<{width}}  {step.why}".rstrip())
    counts = [f"{sum(step.state == state for step in steps)} {state}" for state in STATES]
    live = holder(run.work / "lock")
    print(f"profile {run.profile.name}: {', '.join(counts)}, of {len(steps)} steps" + (f"; {live} is at work" if live else ""))
    return 0
