"""What a network costs: parameters, multiply-accumulates, time and memory of inference (paper, table "Overhead Comparison")."""

import contextlib
import functools
import statistics
import time
import weakref
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple, get_args

import torch
from torch.utils._python_dispatch import TorchDispatchMode
from torch.utils._pytree import tree_leaves
from torch.utils.flop_counter import FlopCounterMode

from dualdepth.device import Precision


class Cost(NamedTuple):
    """Size of a network and work of one inference."""

    params: int
    """Numbers in all parameters, frozen ones included, shared ones once; buffers are not counted."""
    macs: int
    """Multiply-accumulates of convolutions and matrix products; the paper's "GFLOPs" are 10⁹ of these (docs/networks.md)."""


class Latency(NamedTuple):
    """Time and memory of one inference."""

    median_ms: float
    peak_mb: float
    """10⁶ bytes of tensors alive at once: weights, inputs, and whatever inference allocates through torch on top of them."""
    device: str
    """`cpu`, or the GPU's name."""


def count(model: torch.nn.Module, *inputs: torch.Tensor, **options: Any) -> Cost:
    """Count parameters and multiply-accumulates of `model(*inputs)` in eval mode.

    The forward runs on the meta device, which computes shapes only, so it takes no time and no memory; a model that cannot run there
    runs where it is. `FlopCounterMode` counts two operations a multiply-accumulate, so its sum is halved: a 3→8 convolution
    of 3×3 on 16×16 pixels is 55,296.

    Args:
        model: left unchanged.
        *inputs: tensors of the size that counts, such as (1, 3, 384, 1248), on any device; their values do not matter.
        **options: handed to the model.
    """
    params = sum(parameter.numel() for parameter in model.parameters())
    with _eval_mode(model):
        try:
            state = {name: value.to("meta") for name, value in (*model.named_parameters(), *model.named_buffers())}
            flops = _flops(lambda: torch.func.functional_call(model, state, tuple(value.to("meta") for value in inputs), options))
        except (NotImplementedError, RuntimeError):
            device = next((parameter.device for parameter in model.parameters()), torch.device("cpu"))
            real = [torch.zeros_like(value, device=device) for value in inputs]
            flops = _flops(lambda: model(*real, **options))
    return Cost(params, flops // 2)


def latency(model: torch.nn.Module, *inputs: torch.Tensor, repeats: int = 10, precision: Precision = "float32", **options: Any) -> Latency:
    """Measure `model(*inputs)` in eval mode on the device of its inputs.

    Args:
        model, *inputs: on one device; left unchanged, and a batch as it will be used, such as (1, 3, 384, 1248).
        repeats: timed runs, of which the median counts. One before them chooses kernels and fills caches; its memory is what is measured.
        precision: `bf16` runs under autocast, with the weights in float32.
        **options: handed to the model.
    """
    if precision not in get_args(Precision):
        raise ValueError(f"precision {precision!r} is unknown: choose one of {', '.join(get_args(Precision))}")
    device = inputs[0].device
    cuda = device.type == "cuda"
    times = []
    autocast = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
    with _eval_mode(model), torch.inference_mode(), autocast:
        run = functools.partial(model, *inputs, **options)
        extra = _cuda_peak(run, device) if cuda else _cpu_peak(run)
        for _ in range(repeats):
            if cuda:
                torch.cuda.synchronize(device)
            start = time.perf_counter()
            run()
            if cuda:
                torch.cuda.synchronize(device)
            times.append(time.perf_counter() - start)
    held = sum(value.numel() * value.element_size() for value in (*model.parameters(), *model.buffers(), *inputs))
    name = torch.cuda.get_device_name(device) if cuda else device.type
    return Latency(statistics.median(times) * 1e3, (held + extra) / 1e6, name)


def _flops(run: Callable[[], object]) -> int:
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        run()
    return counter.get_total_flops()


def _cuda_peak(run: Callable[[], object], device: torch.device) -> int:
    """Bytes that one inference allocates at most, on top of what is there."""
    before = torch.cuda.memory_allocated(device)
    torch.cuda.reset_peak_memory_stats(device)
    run()
    torch.cuda.synchronize(device)
    return torch.cuda.max_memory_allocated(device) - before


def _cpu_peak(run: Callable[[], object]) -> int:
    """The same on the CPU, from the lifetimes of the tensors; scratch memory inside an operation is not seen."""
    with _Alive() as alive:
        run()
    return alive.peak


class _Alive(TorchDispatchMode):
    """Bytes of tensor storage that operations inside the block made and that are still referenced."""

    def __init__(self) -> None:
        super().__init__()
        self.bytes = self.peak = 0
        self.seen: dict[int, weakref.ref] = {}

    def __torch_dispatch__(self, func: Callable, types: Any, args: tuple = (), kwargs: dict | None = None) -> Any:
        given = {value.untyped_storage()._cdata for value in tree_leaves((args, kwargs)) if isinstance(value, torch.Tensor)}
        result = func(*args, **(kwargs or {}))
        for value in tree_leaves(result):
            if isinstance(value, torch.Tensor) and value.untyped_storage()._cdata not in given | self.seen.keys():
                self._watch(value.untyped_storage())
        return result

    def _watch(self, storage: torch.UntypedStorage) -> None:
        key, size = storage._cdata, storage.nbytes()

        def released(_: weakref.ref) -> None:
            self.bytes -= size
            del self.seen[key]

        self.seen[key] = weakref.ref(storage, released)
        self.bytes += size
        self.peak = max(self.peak, self.bytes)


@contextlib.contextmanager
def _eval_mode(model: torch.nn.Module) -> Iterator[None]:
    """Eval mode for all modules, and back to the mode that each one had."""
    modes = {module: module.training for module in model.modules()}
    model.eval()
    try:
        yield
    finally:
        for module, training in modes.items():
            module.training = training
