"""The dual network of the paper by PyTorch, compiled PyTorch and ONNX Runtime, one beside the other: a part of `make bench`."""

import contextlib
import os
import statistics
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from dualdepth.errors import InputError
from dualdepth.networks.architecture import Architecture
from dualdepth.onnx_export import ImageToDisparity, metadata, write_onnx
from dualdepth.onnx_session import load_onnx, require_packages
from dualdepth.predict import DepthNet

SIZE = (384, 1248)
Rows = list[tuple[str, float, str]]


def runtimes(repeats: int, encoder: str = "resnet50", size: tuple[int, int] = SIZE) -> Rows:
    """Latencies of one image in float32 on the CPU, with as many threads each, and their ratios to PyTorch's: rows what, value, unit.

    The three take turns, so that a machine that is busy for a while is so for all. What cannot run here says why and has no value.

    Args:
        repeats: timed turns, of which the median counts.
        encoder: of LR-Net.
        size: (height, width).
    """
    torch.manual_seed(0)
    depth_net = DepthNet(Architecture("dual", encoder).build().eval(), Architecture("dual", encoder), size)
    # as trainings have it, and before anything is compiled, which a change of layout would undo; ONNX Runtime chooses its own
    net = ImageToDisparity(depth_net).eval().to(memory_format=torch.channels_last)
    image = torch.rand(1, 3, *size).contiguous(memory_format=torch.channels_last)
    rows: Rows = []
    runs: dict[str, Callable[[], object]] = {}
    with tempfile.TemporaryDirectory() as folder, torch.inference_mode():
        for name, make in (("compiled PyTorch", compiled), ("ONNX Runtime", in_onnx_runtime)):
            began = time.perf_counter()
            try:
                runs[name] = make(net, depth_net, image, Path(folder))
            except InputError as error:
                rows.append((f"  {name}: {error}", float("nan"), "ms"))
            else:
                rows.append((f"  {name}: made ready once in", time.perf_counter() - began, "s"))
        runs = {"PyTorch": lambda: net(image), **runs}
        medians = in_turns(runs, repeats)
    where = f"inference, dual {size[0]}x{size[1]}, float32, CPU"
    rows = [(f"{where}, {name}", 1e3 * seconds, "ms") for name, seconds in medians.items()] + rows
    return rows + [(f"  {name} / PyTorch", seconds / medians["PyTorch"], "ratio") for name, seconds in medians.items() if name != "PyTorch"]


def compiled(net: ImageToDisparity, depth_net: DepthNet, image: torch.Tensor, folder: Path) -> Callable[[], object]:
    """`torch.compile`, with a cache of its own, so that it is compiled and not found from before.

    Raises:
        InputError: this machine cannot; it needs a C++ compiler.
    """
    with _environment("TORCHINDUCTOR_CACHE_DIR", str(folder / "inductor")):
        run = torch.compile(net)
        try:
            run(image)
        except Exception as error:  # whatever a compiler may say
            reason = str(error).strip().partition("\n")[0][:120]
            raise InputError(f"cannot be compiled here ({reason}); torch.compile needs a C++ compiler, such as g++") from None
    return lambda: run(image)


def in_onnx_runtime(net: ImageToDisparity, depth_net: DepthNet, image: torch.Tensor, folder: Path) -> Callable[[], object]:
    """The exported network.

    Raises:
        InputError: a package is not installed.
    """
    require_packages("onnx", "onnxscript", "onnxruntime")
    card = depth_net.architecture.words() | {"hr_size": list(depth_net.hr_size)}
    write_onnx(net, depth_net.hr_size, folder / "dual.onnx", metadata(card, depth_net))
    loaded, array = load_onnx(folder / "dual.onnx", torch.get_num_threads()), image.contiguous().numpy()
    loaded(array)
    return lambda: loaded(array)


def in_turns(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Median seconds of each run, one of each a turn; the first turn does not count."""
    times: dict[str, list[float]] = {name: [] for name in runs}
    for _ in range(repeats + 1):
        for name, run in runs.items():
            began = time.perf_counter()
            run()
            times[name].append(time.perf_counter() - began)
    return {name: statistics.median(seconds[1:]) for name, seconds in times.items()}


@contextlib.contextmanager
def _environment(name: str, value: str) -> Iterator[None]:
    """An environment variable for a while."""
    before = os.environ.get(name)
    os.environ[name] = value
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]
        else:
            os.environ[name] = before
