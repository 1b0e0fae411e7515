"""`dualdepth evaluate`: depth metrics of a file of predictions, errors of a predicted camera trajectory, and the guard against leaks."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from dualdepth.errors import InputError

if TYPE_CHECKING:
    import numpy as np


def add_evaluate(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommands `evaluate depth` and `evaluate odometry`; the first choice of each option is the default."""
    parser = commands.add_parser("evaluate", help="score predictions by the field's protocols")
    kinds = parser.add_subparsers(title="what to evaluate", metavar="KIND", required=True)
    _add_depth(kinds)
    _add_odometry(kinds)


def _add_depth(kinds: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = kinds.add_parser(
        "depth",
        help="the seven depth metrics of a prediction file",
        description="Score depth predictions by the field's protocol (Eigen split) and print the means over images.",
    )
    parser.add_argument("--pred", required=True, metavar="P.npy", help="(N, h, w) float array of predictions, any size")
    parser.add_argument("--gt", required=True, metavar="G.npz", help="ground truth of data_scripts/export_depth.py: one array per image")
    parser.add_argument("--kind", choices=("depth", "disparity"), default="depth", help="what P holds (default: %(default)s)")
    parser.add_argument(
        "--resize",
        choices=("depth", "disparity"),
        default="depth",
        help="what is resized to the image's size: depth as SfMLearner and GeoNet, disparity as monodepth2 (default: %(default)s)",
    )
    parser.add_argument("--crop", choices=("garg", "eigen", "none"), default="garg", help="region that is scored (default: %(default)s)")
    parser.add_argument("--min-depth", type=float, default=1e-3, metavar="M", help="metres (default: %(default)s)")
    parser.add_argument("--max-depth", type=float, default=80.0, metavar="M", help="metres (default: %(default)s)")
    parser.add_argument("--no-median-scaling", dest="median_scaling", action="store_false", help="predictions are in metres already")
    parser.add_argument(
        "--valid",
        choices=("range", "positive"),
        default="range",
        help="pixels that count: ground truth between the depths, or all above 0, as for the improved ground truth (default: %(default)s)",
    )
    parser.add_argument("--allow-pickle", action="store_true", help="read the field's pickled gt_depths.npz; only from a source you trust")
    _add_json_and_guard(parser, "--list", "FILE", "list of the frames, as given to data_scripts/export_depth.py")
    parser.set_defaults(run=_evaluate_depth)


def _add_odometry(kinds: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    parser = kinds.add_parser(
        "odometry",
        help="errors of a camera trajectory against the true one",
        description="Score a trajectory: KITTI's segments (t_err in %, r_err in degrees per 100 m), whole (ate, rpe_t in m, rpe_r in"
        " degrees), and SfMLearner's snippets (snippet_ate, sqrt(sum)/N in m; n snippets of consecutive frames).",
    )
    file_format = "12 numbers a line ([R|t], camera to world), or 13 with the frame's number first"
    parser.add_argument("--pred", required=True, metavar="POSES.txt", help=f"KITTI pose file: {file_format}")
    parser.add_argument("--gt", required=True, metavar="POSES.txt", help="the true poses of the whole sequence, in the same format")
    parser.add_argument("--snippet", type=int, choices=(3, 5), default=3, help="frames in a snippet (default: %(default)s)")
    parser.add_argument(
        "--align",
        choices=("7dof", "none", "scale", "6dof", "scale_7dof"),
        default="7dof",
        help="how the prediction is laid on the truth before all but the snippets are scored (default: %(default)s)",
    )
    _add_json_and_guard(parser, "--sequence", "09", "KITTI odometry sequence of the poses, which tells its raw drive")
    parser.set_defaults(run=_evaluate_odometry)


def _add_json_and_guard(parser: argparse.ArgumentParser, frames: str, metavar: str, meaning: str) -> None:
    """Add `--json`, and against leaks `--weights`, the option that names the frames, and `--allow-leak`."""
    parser.add_argument(
        "--json", metavar="OUT", help="write the numbers as flat JSON to a file, or with - to standard output alone; null: not measurable"
    )
    guard = parser.add_argument_group(
        "guard against leaks", f"refuses frames of drives that the network was trained on; needs both {frames}"
    )
    guard.add_argument("--weights", metavar="W.safetensors", help="weights that predicted; their card says what they were trained on")
    guard.add_argument(frames, metavar=metavar, help=meaning)
    guard.add_argument("--allow-leak", action="store_true", help="score all the same, and mark the result")


def _evaluate_depth(arguments: argparse.Namespace) -> int:
    """Score a file of predictions and print or write the result."""
    from dataclasses import fields

    from tqdm import tqdm

    from dualdepth.data.depth_maps import load_ground_truth
    from dualdepth.data.kitti import read_frame_list
    from dualdepth.evaluation.depth import Protocol, evaluate, summary

    protocol = {field.name: getattr(arguments, field.name) for field in fields(Protocol)}
    Protocol(**protocol)
    leak = _leak_of(arguments, arguments.list, "--list", lambda path: sorted({frame.drive for frame in read_frame_list(path)}))
    predictions = load_predictions(arguments.pred)
    ground_truths = load_ground_truth(arguments.gt, allow_pickle=arguments.allow_pickle)
    count = len(ground_truths)
    if arguments.list and (frames := len(read_frame_list(arguments.list))) != count:
        raise InputError(f"{arguments.list}: lists {frames} frames but {arguments.gt} holds {count}; give the list it was made from")
    if len(predictions) != count:
        raise InputError(
            f"{arguments.pred}: holds {len(predictions)} predictions but {arguments.gt} holds {count} ground truths;"
            " give one for each, in the same order"
        )
    # shown in a terminal only: a bar in a pipe would break the one-line error
    shown = tqdm(ground_truths, "scoring", unit="image", disable=None, leave=False)
    _report(summary(evaluate(predictions, shown, name=arguments.pred, **protocol)) | leak, arguments.json)
    return 0


def load_predictions(path: str | Path) -> "np.ndarray":
    """Open a file of predictions, as the field saves them, without reading it into memory and without pickle.

    Returns:
        (N, h, w) float array, mapped from the file.

    Raises:
        InputError: missing, truncated, no `.npy`, or not a float array of three dimensions with at least one image.
    """
    import numpy as np

    if not Path(path).is_file():
        raise InputError(f"{path}: no such file; give a .npy file with an (N, h, w) float array")
    try:
        values = np.load(path, mmap_mode="r", allow_pickle=False)
    except Exception as error:  # of numpy, tokenize and zipfile: ten kinds and more
        raise InputError(f"{path}: not a readable .npy file, or truncated ({error}); write it with numpy.save") from None
    if not isinstance(values, np.ndarray):
        raise InputError(f"{path}: an archive of arrays; give a .npy file with one (N, h, w) float array")
    if values.dtype.kind != "f":
        raise InputError(f"{path}: holds {values.dtype} values; predictions must be floats")
    if values.ndim != 3 or 0 in values.shape:
        raise InputError(f"{path}: has shape {values.shape}; expected (N, h, w), one map for each image")
    return values


def _evaluate_odometry(arguments: argparse.Namespace) -> int:
    """Score a trajectory; what its frames cannot give, such as segments of a path below 100 m, is None, and why stands on stderr."""
    import math
    import sys

    from dualdepth.data.odometry import drives_to_guard, pair_frames, read_trajectory
    from dualdepth.evaluation.odometry import SEGMENTS, snippet_errors, snippets, trajectory_errors

    leak = _leak_of(arguments, arguments.sequence, "--sequence", drives_to_guard)
    prediction, truth = read_trajectory(arguments.pred), read_trajectory(arguments.gt)
    frames, poses, true_poses = pair_frames(prediction, truth, (arguments.pred, arguments.gt))
    if len(frames) < 2:
        raise InputError(f"{arguments.pred} and {arguments.gt} have only frame {frames[0]} in common; a trajectory needs two")
    ate = snippet_errors(*(snippets(p, arguments.snippet, frames) for p in (true_poses, poses)))["ate"]
    numbers = trajectory_errors(truth, prediction, arguments.align)
    notes = [
        (
            not numbers.pop("segments"),
            f"t_err, r_err: none, since no segment of more than {SEGMENTS[0]} m of the true path has both ends predicted",
        ),
        (math.isnan(numbers["rpe_t"]), "rpe_t, rpe_r: none, since no two frames have consecutive numbers"),
        (not len(ate), f"snippet_ate: none, since no {arguments.snippet} frames have consecutive numbers"),
    ]
    for missing, note in notes:
        if missing:
            print(f"note: {note}", file=sys.stderr)
    numbers |= {"snippet_ate_mean": float(ate.mean()), "snippet_ate_std": float(ate.std(ddof=0))}
    _report({name: None if math.isnan(value) else value for name, value in numbers.items()} | {"n": len(ate)} | leak, arguments.json)
    return 0


def _leak_of(arguments: argparse.Namespace, given: str | None, option: str, drives: Callable[[str], list[str]]) -> dict[str, str]:
    """`{"leak": …}` for the result where an allowed leak is, nothing where there is none or nobody asked.

    `given` is what `option` names the frames by, of which `drives` tells the drives. A leak that is not allowed is an `InputError`.
    """
    if not (arguments.weights or given):
        return {}
    if not (arguments.weights and given):
        raise InputError(f"--weights and {option} guard together against leaks: give both or neither")
    from dualdepth.evaluation.leaks import check_leak
    from dualdepth.training.weights import load_card

    leak = check_leak(load_card(arguments.weights), drives(given), allow=arguments.allow_leak, weights=arguments.weights)
    return {"leak": leak} if leak else {}


def _report(result: dict[str, float | int | str | None], json_out: str | None) -> None:
    """Print a result as a table, and write it as JSON where `json_out` says; `-` prints the JSON alone. None was not measurable."""
    import json

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
