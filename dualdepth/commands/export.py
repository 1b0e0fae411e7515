"""`dualdepth export`: trained weights as a file that other programs run."""

import argparse


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
    parser.set_defaults(run=export)


def export(arguments: argparse.Namespace) -> int:
    """Export and say what was written and how near to PyTorch it is.

    Raises:
        InputError: what `export_onnx` says.
    """
    from dualdepth.inference.export import TOLERANCE, export_onnx

    done = export_onnx(arguments.weights, arguments.out, arguments.frames)
    (height, width), (h, w) = done.size, done.output_size
    print(f"{done.path}: image (B, 3, {height}, {width}) -> disparity (B, 1, {h}, {w}), {done.path.stat().st_size / 1e6:.1f} MB")
    if done.difference is None:
        print("not compared with PyTorch: onnxruntime is not installed; `pip install onnxruntime` brings it")
    else:
        print(f"largest relative difference from PyTorch on {done.images} images: {done.difference:.2g} (tolerance {TOLERANCE:g})")
    return 0
