"""What the commands that evaluate share: the guard against leaks, and what they print and write."""

import argparse
from collections.abc import Callable


def add_leak_guard(parser: argparse.ArgumentParser, frames: str, metavar: str, meaning: str) -> None:
    """Add `--weights`, the option that names the frames, and `--allow-leak`."""
    guard = parser.add_argument_group(
        "guard against leaks", f"refuses frames of drives that the network was trained on; needs both {frames}"
    )
    guard.add_argument("--weights", metavar="W.safetensors", help="weights that predicted; their card says what they were trained on")
    guard.add_argument(frames, metavar=metavar, help=meaning)
    guard.add_argument("--allow-leak", action="store_true", help="score all the same, and mark the result")


def leak_of(arguments: argparse.Namespace, given: str | None, option: str, drives: Callable[[str], list[str]]) -> dict[str, str]:
    """`{"leak": …}` for the result where an allowed leak is, nothing where there is none or nobody asked.

    Args:
        arguments: with `weights` and `allow_leak`.
        given: what names the frames.
        option: that gives it.
        drives: of what is given.

    Raises:
        InputError: a leak that is not allowed, or one option without the other.
    """
    from dualdepth.errors import InputError

    if not (arguments.weights or given):
        return {}
    if not (arguments.weights and given):
        raise InputError(f"--weights and {option} guard together against leaks: give both or neither")
    from dualdepth.evaluation.leaks import check_leak
    from dualdepth.training.weights import load_card

    leak = check_leak(load_card(arguments.weights), drives(given), allow=arguments.allow_leak, weights=arguments.weights)
    return {"leak": leak} if leak else {}


def report(result: dict[str, float | int | str | None], json_out: str | None) -> None:
    """Print `result` as a table, and write it as JSON where `json_out` says; `-` prints the JSON alone.

    A number that could not be measured is None: `none` in the table, `null` in the JSON.

    Raises:
        InputError: the JSON file cannot be written.
    """
    import json

    from dualdepth.errors import InputError
    from dualdepth.files import write_json

    if json_out == "-":
        print(json.dumps(result, allow_nan=False))
        return
    if json_out:
        try:
            write_json(json_out, result)
        except OSError as error:
            raise InputError(f"{json_out}: cannot write the result ({error.strerror})") from None
    width = max(len(name) for name in result)
    for name, value in result.items():
        shown = "none" if value is None else f"{value:.4f}" if isinstance(value, float) else value
        print(f"{name:<{width}}  {shown}")
