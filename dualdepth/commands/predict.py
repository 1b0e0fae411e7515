"""`dualdepth predict` and `dualdepth export`: depth of images and videos with trained weights, and these as a file for other programs."""

import argparse
import math
from pathlib import Path

from dualdepth.errors import InputError

KINDS = ("colour", "depth", "side", "npy", "ply")


def add_predict(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `predict`."""
    parser = commands.add_parser(
        "predict",
        help="depth of images, folders and videos with trained weights",
        description="Predict relative depth of images and videos of any size, at their own size. Depth is relative: its unit is unknown."
        " A broken file is named and skipped, and the exit code is then 1. The same command goes on where it was stopped: a"
        " result is kept unless its input, the weights or an option that shapes results has changed since.",
    )
    parser.add_argument("inputs", nargs="+", metavar="INPUT", help="image, video, folder of them, or pattern in quotes ('in/**/*.jpg')")
    parser.add_argument(
        "--weights",
        required=True,
        metavar="W",
        help="model.safetensors with its card beside it, its folder, or owner/name on the model hub",
    )
    parser.add_argument("--out", required=True, metavar="DIR", help="folder of the results; predictions.json in it says what is what")
    parser.add_argument(
        "--save",
        type=_kinds,
        metavar="KINDS",
        help="some of colour (picture with a bar), depth (16-bit PNG, value / 256 as KITTI's), side (image and colours side by side; of a"
        " video an MP4), npy (float32 array), ply (point cloud), with commas, or all (default: colour,depth of an image, side of a video;"
        " the others are made of each frame of a video)",
    )
    parser.add_argument("--device", metavar="D", help="cpu, cuda, cuda:1, mps (default: a GPU where there is one)")
    parser.add_argument(
        "--precision",
        choices=("float32", "bf16"),
        help="(default: bf16 on a CUDA GPU that has it, else float32; a CPU without bf16 instructions is very slow in it)",
    )
    parser.add_argument("--batch-size", type=int, metavar="N", help="images computed together (default: 16 on a GPU or what fits, else 1)")
    parser.add_argument(
        "--scale",
        type=float,
        default=1.0,
        metavar="S",
        help="what depth is multiplied by in all results, such as metres per unit (default: 1)",
    )
    camera = parser.add_mutually_exclusive_group()
    camera.add_argument("--intrinsics", type=float, nargs=4, metavar=("FX", "FY", "CX", "CY"), help="in pixels of the input, for ply")
    camera.add_argument("--focal", type=float, metavar="PX", help="focal length in pixels of the input, for ply")
    camera.add_argument("--fov", type=float, metavar="DEG", help="horizontal field of view, for ply (default: KITTI's 81.4 degrees)")
    parser.add_argument("--overwrite", action="store_true", help="make results again that would be kept")
    parser.set_defaults(run=_predict)


def add_export(commands: "argparse._SubParsersAction[argparse.ArgumentParser]") -> None:
    """Add the subcommand `export`."""
    parser = commands.add_parser(
        "export",
        help="write a trained depth network as an ONNX file",
        description="Write a trained depth network as one ONNX file: image (B, 3, H, W), RGB, float32 in [0, 1] -> disparity (B, 1, h, w)"
        " of unknown scale; B is free. `dualdepth predict` gives depth = 16 / disparity."
        " It is compared with PyTorch in ONNX Runtime, and kept only if they agree to a thousandth.",
    )
    parser.add_argument("--to", required=True, choices=("onnx",), help="format of the file")
    parser.add_argument("--weights", required=True, metavar="W.safetensors", help="of a training; their card (.json) lies beside them")
    parser.add_argument("--out", required=True, metavar="DEPTH.onnx", help="file to write")
    parser.add_argument("--frames", nargs="+", default=[], metavar="IMAGE", help="compare on these images (default: three made-up ones)")
    parser.set_defaults(run=_export)


def _predict(arguments: argparse.Namespace) -> int:
    """Predict all inputs and say what came of it; 1 where some were broken."""
    from dualdepth.inference.inputs import find_inputs, plan
    from dualdepth.inference.outputs import KITTI_FIELD_OF_VIEW, Camera, Style

    if not (math.isfinite(arguments.scale) and arguments.scale > 0):
        raise InputError(f"--scale {arguments.scale}: must be a positive number")
    if arguments.batch_size is not None and arguments.batch_size < 1:
        raise InputError(f"--batch-size {arguments.batch_size}: must be at least 1")
    fov = KITTI_FIELD_OF_VIEW if arguments.fov is None else arguments.fov
    camera = Camera(tuple(arguments.intrinsics) if arguments.intrinsics else None, arguments.focal, fov).check()
    paths = find_inputs(arguments.inputs)

    from dualdepth.device import keep_freed_memory
    from dualdepth.files import check_writable, locked, remove_leftovers
    from dualdepth.inference.running import Predictor
    from dualdepth.model import load

    keep_freed_memory()
    model = load(arguments.weights, arguments.device, arguments.precision)
    out, style = Path(arguments.out), Style(model.about, arguments.scale, camera)
    weights = f"{model.card['sha256']}: {model.about}"
    options = {"weights": weights, "precision": model.precision, "scale": repr(style.scale), "camera": repr(camera)}
    check_writable(out)
    print(f"{arguments.weights}: {model.about}", flush=True)
    predictor = Predictor(model, out, style, arguments.batch_size)
    try:
        with locked(out / ".predict.lock"):
            for folder in (out, *out.glob("*.frames")):
                remove_leftovers(folder, below=False)
            tasks = plan(paths, out, options, arguments.save, arguments.overwrite)
            todo = [task for task in tasks if task.kinds]
            if any("ply" in task.kinds for task in todo):
                print(f"point clouds: {camera}")
            print(f"{len(todo)} of {len(tasks)} inputs to predict on {model.device} in {model.precision}", flush=True)
            predictor.run(todo)
    except OSError as error:
        raise InputError(f"{out}: results cannot be written ({error}); the same command then goes on where it was") from None
    there = f", {len(tasks) - len(todo)} were there" if len(todo) < len(tasks) else ""
    broken = f", {predictor.broken} broken" if predictor.broken else ""
    print(f"{out}: {predictor.made} predicted{there}{broken}")
    return 1 if predictor.broken else 0


def _kinds(words: str) -> tuple[str, ...]:
    """Kinds of results, each once."""
    kinds = tuple(dict.fromkeys(KINDS if words == "all" else words.split(",")))
    if unknown := [kind for kind in kinds if kind not in KINDS]:
        raise argparse.ArgumentTypeError(f"{unknown[0]!r} is unknown: choose some of {', '.join(KINDS)}, with commas, or all")
    return kinds


def _export(arguments: argparse.Namespace) -> int:
    """Export and say what was written and how near to PyTorch it is."""
    from dualdepth.inference.export import TOLERANCE, export_onnx

    done = export_onnx(arguments.weights, arguments.out, arguments.frames)
    (height, width), (h, w) = done.size, done.output_size
    print(f"{done.path}: image (B, 3, {height}, {width}) -> disparity (B, 1, {h}, {w}), {done.path.stat().st_size / 1e6:.1f} MB")
    if done.difference is None:
        print("not compared with PyTorch: onnxruntime is not installed; `pip install onnxruntime` brings it")
    else:
        print(f"largest relative difference from PyTorch on {done.images} images: {done.difference:.2g} (tolerance {TOLERANCE:g})")
    return 0
