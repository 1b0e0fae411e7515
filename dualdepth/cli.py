"""The command `dualdepth`: what each subcommand takes, and the functions that it calls; what is slow to import is imported when called."""

import argparse
import itertools
import json
import math
import os
import re
import sys
from collections.abc import Callable, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any, NoReturn

from dualdepth import __version__
from dualdepth.device import is_main_process, keep_freed_memory
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import check_writable, write_json
from dualdepth.run import ROOTS, Run, add_roots

EXAMPLES = {
    "dualdepth": ["dualdepth predict photo.jpg --out depth", "dualdepth reproduce --profile tiny"],
    "dualdepth evaluate": ["dualdepth evaluate depth --pred depths.npy --gt gt.npz", "dualdepth evaluate odometry --help"],
    "dualdepth evaluate depth": ["dualdepth evaluate depth --pred disparities.npy --gt gt.npz --kind disparity --json scores.json"],
    "dualdepth evaluate odometry": ["dualdepth evaluate odometry --pred 09.txt --gt poses/09.txt --json scores.json"],
    "dualdepth reproduce": ["dualdepth reproduce --profile tiny", "dualdepth reproduce --profile paper --kitti-root /data/kitti_raw"],
    "dualdepth train": ["dualdepth train --profile tiny", "dualdepth train --profile paper --variant dual --seed 1"],
    "dualdepth notebook": ["dualdepth notebook 03_train_lr --out 03.ipynb --set profile=tiny seed=1"],
    "dualdepth predict": ["dualdepth predict photo.jpg --out depth", "dualdepth predict photo.jpg --save colour,ply --fov 60 --out depth"],
    "python data_scripts/own_camera.py": ["python data_scripts/own_camera.py drive.mp4 --out /data/own --fov 80"],
    "dualdepth export": ["dualdepth export --to onnx --weights work/miniature/runs/dual/seed0/model.safetensors --out depth.onnx"],
}
"""What a `--help` ends with; `tests/test_docs.py` runs or parses each."""
PROFILE = "such as tiny, sample or paper, or a YAML file (default: %(default)s)"


class OneLineParser(argparse.ArgumentParser):
    """An argument parser whose error is one line, without the usage before it, and whose help ends with examples."""

    def parse_args(self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None) -> argparse.Namespace:
        """The same; the numbers of `--intrinsics`, four or, with a size, six, may be words of their own instead of one word."""
        words = [*(sys.argv[1:] if args is None else args)]
        at = words.index("--intrinsics") + 1 if "--intrinsics" in words else len(words)
        numbers = [*itertools.takewhile(re.compile(r"[-+]?\.?\d[-+.\de]*,?").fullmatch, words[at : at + 6])]
        if len(numbers) == 5 or any(map(os.path.exists, numbers[4:])):  # inputs whose names are numbers
            numbers = numbers[:4]
        if len(numbers) > 1:
            words[at - 1 : at + len(numbers)] = [f"--intrinsics={' '.join(numbers)}"]
        return super().parse_args(words, namespace)

    def format_help(self) -> str:
        """The help, and each example on a line."""
        return "\n  ".join([f"{super().format_help()}\nexamples:", *EXAMPLES[self.prog]]) + "\n"

    def error(self, message: str) -> NoReturn:
        """Tell of the mistake and where help is."""
        raise InputError(f"{message}; see `{self.prog} --help`")


def main(argv: list[str] | None = None) -> int:
    """Run the command line by `argv`, without the program's name, or by the process's own arguments; gives the exit code, 0 for success.
    `SystemExit` has code 2 after one line on stderr, for a user's mistake; code 130 after Ctrl-C; code 0 after `--help` or `--version`."""
    with exit_on_input_error():
        arguments = build_parser().parse_args(argv)
        return arguments.run(arguments) or 0


def build_parser() -> argparse.ArgumentParser:
    """The parser with all subcommands; each sets `run`, a function of the parsed arguments that returns the exit code, or None for 0."""
    program = OneLineParser(prog="dualdepth", description="Dual networks for high-resolution depth from videos (ICCV 2019), replicated.")
    program.add_argument("--version", action="version", version=f"dualdepth {__version__}")
    commands = program.add_subparsers(title="commands", metavar="COMMAND", required=True)
    _add_evaluate(commands)
    _add_runs(commands)
    _add_predict(commands)
    _add_export(commands)
    return program


def _command(place: Any, name: str, run: Callable[[argparse.Namespace], int | None], meaning: str) -> OneLineParser:
    """Add a command that calls `run`, whose docstring its help begins with."""
    parser = place.add_parser(name, help=meaning, description=run.__doc__)
    parser.set_defaults(run=run)
    return parser


def _add_evaluate(place: Any) -> None:
    evaluate = place.add_parser("evaluate", help="score predictions by the field's protocols")
    kinds = evaluate.add_subparsers(title="what to evaluate", metavar="KIND", required=True)
    parser = _command(kinds, "depth", _evaluate_depth, "the seven depth metrics of a prediction file")
    parser.add_argument("--pred", required=True, metavar="P.npy", help="(N, h, w) float array, any size, of the list's frames or of G's")
    parser.add_argument("--gt", required=True, metavar="G.npz", help="ground truth of data_scripts/export_depth.py: one array per image")
    _add_choice(parser, "--kind", ("depth", "disparity"), "what P holds")
    _add_choice(parser, "--resize", ("depth", "disparity"), "what is resized: depth as SfMLearner and GeoNet, disparity as monodepth2")
    _add_choice(parser, "--crop", ("garg", "eigen", "none"), "region that is scored")
    parser.add_argument("--min-depth", type=float, default=1e-3, metavar="M", help="metres (default: %(default)s)")
    parser.add_argument("--max-depth", type=float, default=80.0, metavar="M", help="metres (default: %(default)s)")
    parser.add_argument("--no-median-scaling", dest="median_scaling", action="store_false", help="predictions are in metres already")
    _add_choice(parser, "--valid", ("range", "positive"), "ground truth that counts: between the depths, or all above 0 (improved)")
    parser.add_argument("--allow-pickle", action="store_true", help="read pickled maps, as gt_depths.npz; only from a source you trust")
    _add_json_and_guard(parser, "--list", "FILE", "list of the frames, as given to data_scripts/export_depth.py")

    parser = _command(kinds, "odometry", _evaluate_odometry, "errors of a camera trajectory against the true one")
    parser.add_argument("--pred", required=True, metavar="POSES.txt", help="12 numbers a line ([R|t]), or 13 with the frame's number first")
    parser.add_argument("--gt", required=True, metavar="POSES.txt", help="the true poses of the whole sequence, in the same format")
    _add_choice(parser, "--snippet", (3, 5), "frames in a snippet")
    _add_choice(parser, "--align", ("7dof", "none", "scale", "6dof", "scale_7dof"), "how all but snippets are laid on the truth")
    _add_json_and_guard(parser, "--sequence", "09", "KITTI odometry sequence of the poses, which tells its raw drive")


def _add_runs(place: Any) -> None:
    parser = _command(place, "reproduce", _reproduce, "run all notebooks of a profile in order, and only what is not done yet")
    parser.add_argument("--profile", default="miniature", help=PROFILE)
    add_roots(parser)
    parser.add_argument("--seeds", default="", metavar="0,1,2", help="seeds to train instead of the profile's")
    parser.add_argument("--cores", default="all", help="cores Snakemake may use (default: %(default)s)")
    parser.add_argument("snakemake", nargs="*", metavar="-- OPTION", help="after --: options for Snakemake, such as --executor slurm")

    parser = _command(place, "train", _train, "train one variant of a profile, or go on with it")
    parser.add_argument("--profile", default="miniature", help=PROFILE)
    parser.add_argument("--variant", default="lr", help="which network (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, help="of initialisation, order and augmentation (default: %(default)s)")

    parser = _command(place, "notebook", _notebook, "run one notebook by papermill")
    parser.add_argument("name", help="such as 03_train_lr")
    parser.add_argument("--out", required=True, metavar="FILE", help="where the executed copy goes")
    parser.add_argument("--set", nargs="*", default=[], metavar="KEY=VALUE", help="the notebook's parameters")


def _add_predict(place: Any) -> None:
    parser = _command(place, "predict", _predict, "depth of images, folders and videos with trained weights")
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="image, video, folder of them, or pattern in quotes ('in/**/*.jpg')")
    weights = "model.safetensors with its card beside it, its folder, or owner/name on the model hub (default: those of the package)"
    parser.add_argument("--weights", metavar="W", help=weights)
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the results; predictions.json in it says what is what")
    kinds = "some of colour (picture with a bar), depth (16-bit PNG, value / 256 as KITTI's), side (image and colours side by side; of a"
    kinds += " video an MP4), npy (float32 array), ply (point cloud), with commas, or all (default: colour,depth of an image, side of a"
    kinds += " video; the others are made of each frame of a video)"
    parser.add_argument("--save", metavar="KINDS", help=kinds)
    parser.add_argument("--device", metavar="D", help="cpu, cuda, cuda:1, mps (default: a GPU where there is one)")
    precision = "(default: bf16 on a CUDA GPU that has it, else float32; a CPU without bf16 instructions is very slow in it)"
    parser.add_argument("--precision", choices=("float32", "bf16"), help=precision)
    parser.add_argument("--batch-size", type=_number(int), metavar="N", help="images at a time (default: 16 on a GPU or what fits, else 1)")
    parser.add_argument("--scale", type=_number(float), default=1.0, help="what depth is multiplied by, such as metres per unit")
    camera = parser.add_mutually_exclusive_group()
    camera.add_argument("--intrinsics", type=intrinsics, metavar="FX,FY,CX,CY", help="pixels of the input, with commas or blanks, for ply")
    camera.add_argument("--focal", type=_number(float), metavar="PX", help="focal length in pixels of the input, for ply")
    camera.add_argument("--fov", type=_number(float, below=180), metavar="DEG", help="across the image, for ply (default: KITTI's 81.4)")
    parser.add_argument("--overwrite", action="store_true", help="make results again that would be kept")


def _add_export(place: Any) -> None:
    parser = _command(place, "export", _export, "write a trained depth network as an ONNX file")
    parser.add_argument("--to", required=True, choices=("onnx",), help="format of the file")
    parser.add_argument("--weights", required=True, metavar="W.safetensors", help="of a training; their card (.json) lies beside them")
    parser.add_argument("--out", required=True, metavar="DEPTH.onnx", help="file to write")
    parser.add_argument("--frames", nargs="+", default=[], metavar="IMAGE", help="compare on these images (default: three made-up ones)")


def _add_choice(parser: argparse.ArgumentParser, option: str, choices: tuple[str | int, ...], meaning: str) -> None:
    """Add an option whose first choice is the default."""
    parser.add_argument(option, type=type(choices[0]), choices=choices, default=choices[0], help=f"{meaning} (default: %(default)s)")


def _add_json_and_guard(parser: argparse.ArgumentParser, frames: str, metavar: str, meaning: str) -> None:
    """Add `--json`, and against leaks `--weights`, the option that names the frames, and `--allow-leak`."""
    parser.add_argument("--json", metavar="OUT", help="write the numbers as flat JSON to a file, - prints them alone; null: not measurable")
    guard = parser.add_argument_group("guard against leaks", f"refuses frames of drives that were trained on; needs --weights and {frames}")
    guard.add_argument("--weights", metavar="W.safetensors", help="weights that predicted; their card says what they were trained on")
    guard.add_argument(frames, metavar=metavar, help=meaning)
    guard.add_argument("--allow-leak", action="store_true", help="score all the same, and mark the result")


def _number(kind: type, above: float = 0, below: float = math.inf) -> Callable[[str], float]:
    """The type of an option that is a number between two others; argparse names the option and what it was given instead."""

    def number(text: str) -> float:
        value = kind(text)
        if not above < value < below:
            raise argparse.ArgumentTypeError(f"{text} must be above {above:g} and below {below:g}")
        return value

    number.__name__ = "whole number" if kind is int else "number"
    return number


def intrinsics(text: str) -> tuple[float, ...]:
    """The type of an option that is the focal lengths and the principal point, with commas or blanks between them."""
    numbers = tuple(map(_number(float, -math.inf), re.split(r",?\s+|,", text.strip())))
    if len(numbers) != 4 or min(numbers[:2]) <= 0:
        raise argparse.ArgumentTypeError(f"{text} must be FX,FY,CX,CY, of which the focal lengths FX and FY are above 0")
    return numbers


def _evaluate_depth(arguments: argparse.Namespace) -> None:
    """Score depth predictions by the field's protocol (Eigen split) and print the means over images."""
    from dualdepth.data.depth_maps import at_places, load_ground_truth, places_of
    from dualdepth.data.kitti import read_frame_list
    from dualdepth.evaluation.depth import Protocol, evaluate, load_predictions, summary

    keep_freed_memory()
    protocol = {field.name: getattr(arguments, field.name) for field in fields(Protocol)}
    truths = load_ground_truth(arguments.gt, allow_pickle=arguments.allow_pickle)
    frames = read_frame_list(arguments.list) if arguments.list and arguments.weights else []
    places = places_of(truths, len(frames), arguments.list)
    leak = _leak_of(arguments, arguments.list, "--list", lambda _: sorted({frames[place].drive for place in places}))
    predictions = load_predictions(arguments.pred, allow_pickle=arguments.allow_pickle)
    predictions = at_places(predictions, places, len(frames) or truths.listed)
    _report(summary(evaluate(predictions, truths, name=arguments.pred, **protocol)) | leak, arguments.json)


def _evaluate_odometry(arguments: argparse.Namespace) -> None:
    """Score a trajectory, camera to world: KITTI's segments (t_err in %, r_err in degrees per 100 m), whole (ate, rpe_t in m, rpe_r in
    degrees), and SfMLearner's snippets (snippet_ate, sqrt(sum)/N in m; n snippets of consecutive frames). What the frames cannot give,
    such as segments of a path below 100 m, is printed as none; stderr says why.
    """
    from dualdepth.data.odometry import drives_to_guard, pair_frames, read_trajectory
    from dualdepth.evaluation.odometry import SEGMENTS, snippet_errors, snippets, trajectory_errors

    leak = _leak_of(arguments, arguments.sequence, "--sequence", drives_to_guard)
    prediction, truth = read_trajectory(arguments.pred), read_trajectory(arguments.gt)
    frames, poses, true_poses = pair_frames(prediction, truth, (arguments.pred, arguments.gt))
    if len(frames) < 2:
        raise InputError(f"{arguments.pred} and {arguments.gt} have only frame {frames[0]} in common; a trajectory needs two")
    ate = snippet_errors(*(snippets(p, arguments.snippet, frames) for p in (true_poses, poses)))["ate"]
    numbers = trajectory_errors(truth, prediction, arguments.align)
    numbers.pop("segments")
    numbers |= {"snippet_ate_mean": float(ate.mean()), "snippet_ate_std": float(ate.std(ddof=0))}
    reasons = {
        "t_err": f"t_err, r_err: none, since no segment of more than {SEGMENTS[0]} m of the true path has both ends predicted",
        "rpe_t": "rpe_t, rpe_r: none, since no two frames have consecutive numbers",
        "snippet_ate_mean": f"snippet_ate: none, since no {arguments.snippet} frames have consecutive numbers",
    }
    for name, reason in reasons.items():
        if math.isnan(numbers[name]):
            print(f"note: {reason}", file=sys.stderr)
    _report({name: None if math.isnan(value) else value for name, value in numbers.items()} | {"n": len(ate)} | leak, arguments.json)


def _leak_of(arguments: argparse.Namespace, given: str | None, option: str, drives: Callable[[str], list[str]]) -> dict[str, str]:
    """`{"leak": …}` for the result where an allowed leak is, nothing where there is none or nobody asked. `given` is the value of
    `option`; `drives(given)` lists the drives of those frames. A leak that is not allowed is an `InputError`."""
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


def _reproduce(arguments: argparse.Namespace) -> NoReturn:
    """Run all notebooks of a profile in order, and only what is not done yet."""
    from dualdepth.notebooks import run_chain
    from dualdepth.profile import PROFILES

    for word in arguments.snakemake:
        if (PROFILES / f"{word}.yaml").is_file():
            raise InputError(f"{word} is a profile: write --profile {word}")
    given = {name: getattr(arguments, name) for name in ROOTS}
    run_chain(arguments.profile, given, arguments.seeds, arguments.allow_leak, arguments.cores, arguments.snakemake)


def _notebook(arguments: argparse.Namespace) -> None:
    """Run one notebook by papermill."""
    from dualdepth.notebooks import parse_parameters, run_notebook

    run_notebook(arguments.name, arguments.out, parse_parameters(arguments.set))


def _train(arguments: argparse.Namespace) -> None:
    """Train one variant of a profile, or go on with it, and say where the weights are."""
    from dualdepth.training.checkpoints import checkpoint_paths
    from dualdepth.training.variants import train_variant

    if not 0 <= arguments.seed < 2**32:
        raise InputError(f"--seed {arguments.seed}: give a whole number from 0 to 4294967295")
    run = Run(arguments.profile)
    try:
        weights = train_variant(run, arguments.variant, arguments.seed)
    except KeyboardInterrupt:
        kept = checkpoint_paths(run.training(arguments.variant, arguments.seed))
        raise KeyboardInterrupt("" if kept else "no checkpoint is written yet, so the same command begins again") from None
    if is_main_process():
        print(weights)


def _predict(arguments: argparse.Namespace) -> int:
    """Predict relative depth of images and videos of any size, at their own size. Depth is relative: its unit is unknown. A broken file is
    named and skipped, and the exit code is then 1. The same command goes on where it was stopped: a result is kept unless its input, the
    weights or an option that shapes results has changed since.
    """
    from dualdepth.inference.files import find_inputs, predict_files
    from dualdepth.inference.results import SUFFIXES, Style
    from dualdepth.model import RELEASED, load

    if "" in (*arguments.inputs, arguments.out, arguments.weights):
        raise InputError("INPUT, --out or --weights is an empty word ''; give a file or a folder, '.' for the current one")
    kinds = tuple(dict.fromkeys(SUFFIXES if arguments.save == "all" else arguments.save.split(",") if arguments.save else ()))
    if unknown := [kind for kind in kinds if kind not in SUFFIXES]:
        raise InputError(f"--save {unknown[0]!r} is unknown: choose some of {', '.join(SUFFIXES)}, with commas, or all")
    paths = find_inputs(arguments.inputs)
    keep_freed_memory()
    model = load(arguments.weights or RELEASED, arguments.device, arguments.precision)
    check_writable(arguments.out)
    if arguments.weights and RELEASED not in (Path(arguments.weights), Path(arguments.weights).parent):  # for which `load` has printed it
        print(f"{arguments.weights}: {model.about}", flush=True)
    style = Style(model.about, arguments.scale, arguments.intrinsics, arguments.focal, arguments.fov)
    options = {"kinds": kinds, "batch_size": arguments.batch_size, "overwrite": arguments.overwrite}
    return int(not predict_files(paths, Path(arguments.out), model, style, **options))


def _export(arguments: argparse.Namespace) -> None:
    """Write a trained depth network as one ONNX file: image (B, 3, H, W), RGB, float32 in [0, 1] -> disparity (B, 1, h, w) of unknown
    scale; B is free. `dualdepth predict` gives depth = 1 / disparity. It is compared with PyTorch in ONNX Runtime, and kept only if they
    agree to a thousandth.
    """
    from dualdepth.inference.export import export_onnx

    print(export_onnx(arguments.weights, arguments.out, arguments.frames))


if __name__ == "__main__":
    sys.exit(main())
