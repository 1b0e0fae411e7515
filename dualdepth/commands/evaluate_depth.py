"""`dualdepth evaluate depth`: the seven depth metrics of a file of predictions."""

import argparse

from dualdepth.commands.shared import add_leak_guard, leak_of, report


def add_evaluate_depth(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `depth`; the first choice of each option is the default and the field's standard."""
    parser = commands.add_parser(
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
    parser.add_argument("--no-median-scaling", action="store_true", help="predictions are in metres already")
    parser.add_argument(
        "--valid",
        choices=("range", "positive"),
        default="range",
        help="pixels that count: ground truth between the depths, or all above 0, as for the improved ground truth (default: %(default)s)",
    )
    parser.add_argument("--allow-pickle", action="store_true", help="read the field's pickled gt_depths.npz; only from a source you trust")
    add_leak_guard(parser, "--list", "FILE", "list of the frames, as given to data_scripts/export_depth.py")
    parser.add_argument("--json", metavar="OUT", help="write the numbers as flat JSON to a file, or with - to standard output alone")
    parser.set_defaults(run=run)


def run(arguments: argparse.Namespace) -> int:
    """Score the files named by `arguments` and print or write the result.

    Raises:
        InputError: a file is missing, damaged or of the wrong shape, or the numbers of images differ.
    """
    from tqdm import tqdm

    from dualdepth.data.depth_maps import load_ground_truth
    from dualdepth.data.kitti import read_frame_list
    from dualdepth.errors import InputError
    from dualdepth.evaluation.depth import Protocol, evaluate, summary
    from dualdepth.evaluation.predictions import load_predictions

    protocol = {
        "kind": arguments.kind,
        "resize": arguments.resize,
        "crop": arguments.crop,
        "min_depth": arguments.min_depth,
        "max_depth": arguments.max_depth,
        "median_scaling": not arguments.no_median_scaling,
        "valid": arguments.valid,
    }
    Protocol(**protocol)
    leak = leak_of(arguments, arguments.list, "--list", lambda path: sorted({frame.drive for frame in read_frame_list(path)}))
    predictions = load_predictions(arguments.pred)
    ground_truths = load_ground_truth(arguments.gt, allow_pickle=arguments.allow_pickle)
    if arguments.list and len(read_frame_list(arguments.list)) != len(ground_truths):
        frames = len(read_frame_list(arguments.list))
        raise InputError(
            f"{arguments.list}: lists {frames} frames but {arguments.gt} holds {len(ground_truths)}; give the list it was made from"
        )
    if len(predictions) != len(ground_truths):
        raise InputError(
            f"{arguments.pred}: holds {len(predictions)} predictions but {arguments.gt} holds {len(ground_truths)} ground truths;"
            " give one for each, in the same order"
        )
    # shown in a terminal only: a bar in a pipe would break the one-line error
    shown = tqdm(ground_truths, "scoring", unit="image", disable=None, leave=False)
    result = summary(evaluate(predictions, shown, name=arguments.pred, **protocol))
    report(result | leak, arguments.json)
    return 0
