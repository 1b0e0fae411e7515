"""Depth networks as ONNX files: one image in, its disparity out, compared with PyTorch before a file is kept."""

import importlib.util
import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.files import atomic_path, check_writable
from dualdepth.geometry import to_unit
from dualdepth.model import DepthModel, load, tensor_of

IMAGE, DISPARITY = "image", "disparity"  # Names of the graph's input and output.
OPSET = 20  # The operators' version: what torch's exporter writes of itself, without converting.
TOLERANCE = 1e-3
"""Largest |ONNX − PyTorch| / PyTorch of a disparity, both in float32. ONNX Runtime's sigmoid is right to 1.7e-7, which is 1.4e-4 of the
smallest disparities; the rest is for sums in another order. A thousandth is below what any table shows."""
MEND = "try the versions of environment.lock"


def export_onnx(weights: str | Path, out: str | Path, frames: Sequence[str | Path] = ()) -> str:
    """Write the depth network of a training as an ONNX file; gives two lines: what was written, and how near to PyTorch it is.

    It takes the image itself, so that nobody has to average it for LR-Net; what does not shape the finest disparity, such as the decoder of
    a dual network's LR-Net, is left out. The file is compared on `frames`, or on three made-up images. An `InputError` says that a package
    is missing, that weights, card or a frame cannot be read, that nothing can be written at `out`, that the network cannot be exported, or
    that ONNX Runtime differs from PyTorch by more than `TOLERANCE`. No file is left then.
    """
    for name in ("onnx", "onnxscript", "onnxruntime"):
        if importlib.util.find_spec(name) is None:
            raise InputError(f"package {name} is not installed; `pip install onnx onnxscript onnxruntime` (here, `make env`) brings it")
    out = Path(out)
    if out.suffix != ".onnx" or out.is_dir():
        raise InputError(f"{out}: does not end in .onnx or is a folder; give --out the name of a file that ends so")
    model = load(weights, "cpu", "float32")
    rng, (height, width) = np.random.default_rng(0), model.size
    blots = (rng.integers(0, 255, (height // 16, width // 16, 3), np.uint8) for _ in range(3))
    images = [to_unit(tensor_of(image, model.size)).numpy() for image in (map(read_image, frames) if frames else blots)]
    batches = [*(image[None] for image in images), np.stack(images[:3])]
    with torch.inference_mode():
        expected = [model(torch.from_numpy(batch)).numpy() for batch in batches]
    check_writable(out.parent)
    with atomic_path(out) as partial:
        try:
            write_onnx(model, partial)
        except torch.onnx.errors.OnnxExporterError as error:
            reason = str(error.__cause__ or error).partition("\n")[0]
            raise InputError(f"{weights}: torch cannot export encoder {model.architecture.encoder!r} ({reason})") from None
        try:
            found = run_onnx(partial, batches)
        except Exception as error:  # ONNX Runtime's errors have no class in common
            raise InputError(f"{out}: not written, since ONNX Runtime cannot run it ({str(error)[:200]}); {MEND}") from None
        difference = float(np.max([np.abs(ours / theirs - 1).max() for ours, theirs in zip(found, expected)]))
        if not difference <= TOLERANCE:
            off = f"off PyTorch's by {difference:.2g} of their value, more than {TOLERANCE:g}"
            raise InputError(f"{out}: not written, since ONNX Runtime's disparities are {off}; {MEND}")
    sizes = f"image (B, 3, {height}, {width}) -> disparity (B, 1, {expected[0].shape[2]}, {expected[0].shape[3]})"
    written = f"{out}: {sizes}, {out.stat().st_size / 1e6:.1f} MB"
    return f"{written}\nlargest relative difference from PyTorch on {len(images)} images: {difference:.2g} (tolerance {TOLERANCE:g})"


def write_onnx(model: DepthModel, path: str | Path) -> None:
    """Write a model with what is known of it as metadata, and check the file: `image` (B, 3, H, W) → `disparity` (B, 1, h, w), B is free.
    A `torch.onnx.errors.OnnxExporterError` says that torch has no ONNX form of one of its layers."""
    import onnx
    from onnx_ir.passes.common import ClearMetadataAndDocStringPass

    # the exporter would tell of torchvision, which is not used, and of torch's own old names
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    example = torch.zeros(2, 3, *model.size)  # a batch of one would be taken for a constant
    settings = {"input_names": [IMAGE], "output_names": [DISPARITY], "dynamic_shapes": ({0: torch.export.Dim("batch")},)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(model, (example,), dynamo=True, opset_version=OPSET, verbose=False, **settings)
    ClearMetadataAndDocStringPass()(program.model)  # at each node, torch notes the source files of this machine
    program.model.metadata_props.clear()
    program.model.metadata_props.update(
        {
            "about": str(model.card.get("about", f"depth network {model.architecture.network}")),
            IMAGE: f"RGB, float32 in [0, 1], (batch, 3, {model.size[0]}, {model.size[1]}); frames are resized whole to this size",
            DISPARITY: "float32, positive; `dualdepth predict` gives depth = 1 / disparity",
            "scale": "relative: learned from video alone, depths are right up to an unknown factor and no metres",
            "hr_size": json.dumps(model.size),
            "card": json.dumps(model.card, ensure_ascii=False),
        }
    )
    program.save(path, external_data=False)
    onnx.checker.check_model(path, full_check=True)


def run_onnx(path: str | Path, batches: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Disparities (B, 1, h, w) of images (B, 3, H, W) that ONNX Runtime computes by a file on the CPU; its errors are of many classes."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # what goes wrong comes as an exception
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # threads that wait must sleep, as torch's do here
    session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    return [session.run([DISPARITY], {IMAGE: images})[0] for images in batches]
