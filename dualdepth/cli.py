"""The command `dualdepth`: one parser, one small `add_*` function per subcommand."""

import argparse
import sys
from typing import NoReturn

from dualdepth import __version__
from dualdepth.commands.evaluate import add_evaluate
from dualdepth.commands.predict import add_export, add_predict
from dualdepth.commands.reproduce import add_notebook, add_reproduce, add_train
from dualdepth.errors import exit_on_input_error


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose error is one line, without the usage before it."""

    def error(self, message: str) -> NoReturn:
        """Print the mistake and where help is, and exit with code 2."""
        print(f"error: {' '.join(message.split())}; see `{self.prog} --help`", file=sys.stderr)
        raise SystemExit(2)


def build_parser() -> argparse.ArgumentParser:
    """The parser with all subcommands; each sets `run`, a function of the parsed arguments that returns the exit code."""
    parser = OneLineParser(prog="dualdepth", description="Dual networks for high-resolution depth from videos (ICCV 2019), replicated.")
    parser.add_argument("--version", action="version", version=f"dualdepth {__version__}")
    commands = parser.add_subparsers(title="commands", metavar="COMMAND", required=True)
    for add in (add_evaluate, add_reproduce, add_train, add_predict, add_export, add_notebook):
        add(commands)
    return parser


def main(argv: list[str] | None = None) -> int:
    """Run the command line.

    Args:
        argv: arguments without the program's name; None takes those of the process.

    Returns:
        Exit code, 0 for success.

    Raises:
        SystemExit: code 2 after one line on stderr, for a user's mistake; code 0 after `--help` or `--version`.
    """
    arguments = build_parser().parse_args(argv)
    with exit_on_input_error():
        try:
            return arguments.run(arguments)
        except KeyboardInterrupt:
            print("stopped; the same command goes on where it was", file=sys.stderr)
            return 130


if __name__ == "__main__":
    sys.exit(main())
