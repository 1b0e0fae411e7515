"""`dualdepth evaluate odometry`: errors of a predicted camera trajectory."""

import argparse

from dualdepth.commands.shared import add_leak_guard, leak_of, report


def add_evaluate_odometry(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `odometry`; the first choice of each option is the default."""
    parser = commands.add_parser(
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
    add_leak_guard(parser, "--sequence", "09", "KITTI odometry sequence of the poses, which tells its raw drive")
    parser.add_argument(
        "--json", metavar="OUT", help="write the numbers as flat JSON to a file, or with - to standard output alone; null: not measurable"
    )
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Score the files named by `arguments` and print or write the result.

    What the frames cannot give, such as segments of a path below 100 m, is None in the result, and why stands on stderr.

    Raises:
        InputError: a file is missing or damaged, or the two do not fit.
    """
    import math
    import sys

    from dualdepth.data.odometry import drives_to_guard, pair_frames, read_trajectory
    from dualdepth.errors import InputError
    from dualdepth.evaluation.odometry import SEGMENTS, snippet_errors, snippets, trajectory_errors

    leak = leak_of(arguments, arguments.sequence, "--sequence", drives_to_guard)
    prediction, truth = read_trajectory(arguments.pred), read_trajectory(arguments.gt)
    frames, poses, true_poses = pair_frames(prediction, truth, (arguments.pred, arguments.gt))
    if len(frames) < 2:
        raise InputError(f"{arguments.pred} and {arguments.gt} have only frame {frames[0]} in common; a trajectory needs two")
    cut = [snippets(p, arguments.snippet, frames) for p in (true_poses, poses)]
    ate = snippet_errors(*cut)["ate"]
    whole = trajectory_errors(truth, prediction, arguments.align)
    notes = {
        "t_err, r_err": None
        if whole.pop("segments")
        else f"no segment of more than {SEGMENTS[0]} m of the true path has both ends predicted",
        "rpe_t, rpe_r": "no two frames have consecutive numbers" if math.isnan(whole["rpe_t"]) else None,
        "snippet_ate": None if len(ate) else f"no {arguments.snippet} frames have consecutive numbers",
    }
    for names, why in notes.items():
        if why:
            print(f"note: {names}: none, since {why}", file=sys.stderr)
    numbers = whole | {"snippet_ate_mean": float(ate.mean()), "snippet_ate_std": float(ate.std(ddof=0))}
    report({name: None if math.isnan(value) else value for name, value in numbers.items()} | {"n": len(ate)} | leak, arguments.json)
    return 0
