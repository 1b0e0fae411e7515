"""An exported depth network in ONNX Runtime, checked when it is loaded; PyTorch is not needed."""

import importlib.util
import json
from pathlib import Path
from typing import Any

import numpy as np

from dualdepth.errors import InputError

IMAGE, DISPARITY = "image", "disparity"
"""Names of the graph's input and output."""


def require_packages(*names: str) -> None:
    """Make sure that optional packages are there, without loading them.

    Raises:
        InputError: one is not, and how to get it.
    """
    for name in names:
        if importlib.util.find_spec(name) is None:
            wanted = "onnx onnxscript onnxruntime" if "onnxscript" in names else name
            raise InputError(f"package {name} is not installed; `pip install {wanted}` (in the checkout, `make env`) brings it")


class OnnxDepthNet:
    """Images to disparities by ONNX Runtime; made by `load_onnx`.

    Args:
        session: `onnxruntime.InferenceSession` of a file that `dualdepth export` wrote.
        path: of that file, for messages.

    Raises:
        InputError: the file is of something else, or its graph is not what its metadata say.
    """

    def __init__(self, session: Any, path: str | Path) -> None:
        self.session, self.path = session, Path(path)
        try:
            metadata = session.get_modelmeta().custom_metadata_map
            self.card: dict[str, Any] = json.loads(metadata["card"])
            """The weights' card: what they were learned from."""
            height, width = (int(side) for side in json.loads(metadata["hr_size"]))
            shrink = 3 if self.card["network"] == "lr" else 1
            inputs, outputs = _ports(session.get_inputs()), _ports(session.get_outputs())
        except (KeyError, TypeError, ValueError, OverflowError, RecursionError) as error:
            raise InputError(f"{path}: its metadata name no network of this project ({error}); export it with `dualdepth export`") from None
        self.size = (height, width)
        """(height, width) of the images it takes; frames are resized whole to it."""
        self.output_size = (height // shrink, width // shrink)
        """(height, width) of the disparities it gives."""
        _check(inputs, IMAGE, (3, height, width), path)
        _check(outputs, DISPARITY, (1, *self.output_size), path)

    def __call__(self, images: np.ndarray) -> np.ndarray:
        """Disparities (B, 1, h, w) float32, positive, of unknown scale; depth is 1 / disparity.

        Args:
            images: (B, 3, H, W) float32 RGB in [0, 1], of `size`.

        Raises:
            InputError: images of another shape, type or range, or a damaged graph.
        """
        images = np.asarray(images)
        height, width = self.size
        if images.ndim != 4 or images.shape[1:] != (3, height, width) or len(images) == 0:
            raise InputError(f"{self.path}: takes images (B, 3, {height}, {width}), found {images.shape}; resize whole frames to that")
        if images.dtype != np.float32:
            raise InputError(f"{self.path}: takes float32 images in [0, 1], found {images.dtype}; convert them (bytes: divide by 255)")
        low, high = images.min(), images.max()
        if not (low >= 0 and high <= 1):
            raise InputError(f"{self.path}: takes images in [0, 1], found values from {low:.3g} to {high:.3g}; divide bytes by 255")
        try:
            return self.session.run([DISPARITY], {IMAGE: images})[0]
        except Exception as error:  # ONNX Runtime's errors have no class in common
            raise InputError(f"{self.path}: ONNX Runtime cannot run it ({str(error)[:200]}); copy or export it again") from None


def load_onnx(path: str | Path, threads: int = 0) -> OnnxDepthNet:
    """Load a file that `dualdepth export` wrote, on the CPU, and check its shapes against its metadata.

    Args:
        path: the ONNX file.
        threads: that an operation may use; 0 takes a thread for each core.

    Raises:
        InputError: ONNX Runtime is not installed, the file is missing or damaged, or it is of another network or shape.
    """
    require_packages("onnxruntime")
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4  # what goes wrong comes as an exception
    options.intra_op_num_threads = threads
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")  # threads that wait must sleep, as torch's do here
    try:
        session = onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:  # likewise
        raise InputError(f"{path}: cannot be loaded by ONNX Runtime ({str(error)[:200]}); copy or export it again") from None
    return OnnxDepthNet(session, path)


Port = tuple[Any, ...]


def _ports(ports: list[Any]) -> list[Port]:
    """Name, type and shape of a graph's inputs or outputs."""
    return [(port.name, port.type, *port.shape) for port in ports]


def _check(found: list[Port], name: str, shape: tuple[int, ...], path: str | Path) -> None:
    """Raise an `InputError` unless the graph's one input or output has this name and, after a free batch, this shape in float32."""
    if len(found) != 1 or found[0][:2] != (name, "tensor(float)") or isinstance(found[0][2], int) or found[0][3:] != shape:
        raise InputError(f"{path}: has {found} where {name} (B, {', '.join(map(str, shape))}) in float32 is expected; export it again")
