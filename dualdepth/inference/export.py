"""Depth networks as ONNX files: one image in, its disparity out, compared with PyTorch before a file is kept."""

import importlib.util
import json
import logging
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.data.frames import resample
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.files import atomic_path, check_writable
from dualdepth.inference.predict import DepthNet, load_depth_net
from dualdepth.model import UNIT
from dualdepth.training.weights import load_card

IMAGE, DISPARITY = "image", "disparity"
"""Names of the graph's input and output."""
OPSET = 20
"""The operators' version: what torch's exporter writes of itself, without converting."""
TOLERANCE = 1e-3
"""Largest |ONNX − PyTorch| / PyTorch of a disparity, both in float32. ONNX Runtime's sigmoid is right to 1.7e-7, which is 1.4e-4 of the
smallest disparities; the rest is for sums in another order. A thousandth is below what any table shows."""


class ImageToDisparity(nn.Module):
    """What is exported of a depth network: the frame itself in, so that nobody has to average it for LR-Net, the finest disparity out.

    What does not shape that disparity, such as the decoder of a dual network's LR-Net, is not part of the graph.
    """

    def __init__(self, depth_net: DepthNet) -> None:
        super().__init__()
        self.net, self.low = depth_net.net, depth_net.architecture.sees_low_resolution

    def forward(self, image: Tensor) -> Tensor:
        """Disparity (B, 1, h, w) of an image (B, 3, H, W) in [0, 1]; h, w are H, W, or a third of them for LR-Net."""
        return self.net(F.avg_pool2d(image, 3) if self.low else image, scales=1).disparities[0]


class Export(NamedTuple):
    """What was written, and how near to PyTorch it is."""

    path: Path
    size: tuple[int, int]
    """(height, width) of the images."""
    output_size: tuple[int, int]
    """(height, width) of the disparities."""
    images: int
    """Number of images the comparison used."""
    difference: float | None
    """Largest |ONNX − PyTorch| / PyTorch over their pixels; None where ONNX Runtime is not installed."""


def export_onnx(weights: str | Path, out: str | Path, frames: Sequence[str | Path] = ()) -> Export:
    """Write the depth network of a training as an ONNX file.

    Args:
        weights: safetensors file; its card lies beside it.
        out: the file, `….onnx`.
        frames: image files to compare on; without any, three made-up images are.

    Raises:
        InputError: a package is missing; the weights, their card or a frame cannot be read; nothing can be written at `out`; the
            network cannot be exported; or ONNX Runtime's disparities differ from PyTorch's by more than `TOLERANCE`. No file is left.
    """
    for name in ("onnx", "onnxscript"):
        if importlib.util.find_spec(name) is None:
            raise InputError(f"package {name} is not installed; `pip install onnx onnxscript onnxruntime` (here, `make env`) brings it")
    out = Path(out)
    if out.suffix != ".onnx" or out.is_dir():
        raise InputError(f"{out}: is no name for an ONNX file; give --out one that ends in .onnx")
    depth_net = load_depth_net(weights)
    net, size = ImageToDisparity(depth_net).eval(), depth_net.hr_size
    images = [_read(path, size) for path in frames] or made_up_images(size)
    batches = [*(image[None] for image in images), np.stack(images[:3])]
    try:
        with torch.inference_mode():
            expected = [net(torch.from_numpy(batch)).numpy() for batch in batches]
    except RuntimeError as error:
        raise InputError(f"{weights}: its network cannot see images of its card's {size} ({error}); copy both again") from None
    check_writable(out.parent)
    with atomic_path(out) as partial:
        try:
            write_onnx(net, size, partial, _about(load_card(weights), depth_net))
        except torch.onnx.errors.OnnxExporterError as error:
            reason = str(error.__cause__ or error).partition("\n")[0]
            raise InputError(f"{weights}: torch cannot export encoder {depth_net.architecture.encoder!r} ({reason})") from None
        difference = _difference(partial, batches, expected, out) if importlib.util.find_spec("onnxruntime") else None
    return Export(out, size, expected[0].shape[-2:], len(images), difference)


def write_onnx(net: nn.Module, size: tuple[int, int], path: str | Path, words: dict[str, str]) -> None:
    """Write a network in eval mode, and `words` as its metadata, and check the file.

    Its input `image` is (B, 3, *size) with `size` (height, width), its output `disparity` (B, 1, h, w); B is free.

    Raises:
        torch.onnx.errors.OnnxExporterError: torch has no ONNX form of one of its layers.
    """
    import onnx
    from onnx_ir.passes.common import ClearMetadataAndDocStringPass

    # the exporter would tell of torchvision, which is not used, and of torch's own old names
    logging.getLogger("torch.onnx._internal.exporter._registration").setLevel(logging.ERROR)
    example = torch.zeros(2, 3, *size)  # a batch of one would be taken for a constant
    settings = {"input_names": [IMAGE], "output_names": [DISPARITY], "dynamic_shapes": ({0: torch.export.Dim("batch")},)}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        program = torch.onnx.export(net, (example,), dynamo=True, opset_version=OPSET, verbose=False, **settings)
    ClearMetadataAndDocStringPass()(program.model)  # at each node, torch notes the source files of this machine
    program.model.metadata_props.clear()
    program.model.metadata_props.update(words)
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


def made_up_images(size: tuple[int, int], count: int = 3) -> list[np.ndarray]:
    """Images (3, H, W) float32 in [0, 1], of large and small blots: something to see at every stride."""
    rng, (height, width) = np.random.default_rng(0), size
    images = []
    for _ in range(count):
        layers = [resample(rng.integers(0, 255, (height // s + 1, width // s + 1, 3), np.uint8), size) for s in (64, 16, 4)]
        images.append(_unit(np.mean(layers, axis=0, dtype=np.float32)))
    return images


def _difference(path: Path, batches: Sequence[np.ndarray], expected: Sequence[np.ndarray], out: Path) -> float:
    """Of a file's disparities from PyTorch's, which must not be above `TOLERANCE`; `out` is what the file will be called."""
    mend = "try the versions of environment.lock"
    try:
        found = run_onnx(path, batches)
    except Exception as error:  # ONNX Runtime's errors have no class in common
        raise InputError(f"{out}: not written, since ONNX Runtime cannot run it ({str(error)[:200]}); {mend}") from None
    difference = float(np.max([np.abs(ours / theirs - 1).max() for ours, theirs in zip(found, expected)]))
    if not difference <= TOLERANCE:
        off = f"off PyTorch's by {difference:.2g} of their value, more than {TOLERANCE:g}"
        raise InputError(f"{out}: not written, since ONNX Runtime's disparities are {off}; {mend}")
    return difference


def _about(card: dict[str, Any], depth_net: DepthNet) -> dict[str, str]:
    """What the file says of itself."""
    height, width = depth_net.hr_size
    return {
        "about": str(card.get("about", f"depth network {depth_net.architecture.network}")),
        IMAGE: f"RGB, float32 in [0, 1], (batch, 3, {height}, {width}); frames are resized whole to this size",
        DISPARITY: f"1 / depth, float32, positive; `dualdepth predict` gives {UNIT:g} / disparity",
        "scale": "relative: learned from video alone, depths are right up to an unknown factor and no metres",
        "hr_size": json.dumps([height, width]),
        "card": json.dumps(card, ensure_ascii=False),
    }


def _read(path: str | Path, size: tuple[int, int]) -> np.ndarray:
    return _unit(resample(read_image(path), size))


def _unit(image: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(image.transpose(2, 0, 1)) / np.float32(255)
