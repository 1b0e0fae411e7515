"""What a network costs: parameters, multiply-accumulates, time and memory of inference (paper, table "Overhead Comparison")."""

import copy
import itertools
import os
import statistics
import timeit
from typing import Any, NamedTuple

import torch
from torch.utils.flop_counter import FlopCounterMode

from dualdepth.device import Precision


class Cost(NamedTuple):
    """Size of a network and work of one inference."""

    params: int  # numbers in all parameters, frozen ones included, shared ones once; buffers are not counted
    macs: int  # multiply-accumulates of convolutions and matrix products; the paper's "GFLOPs" are 10⁹ of these (docs/networks.md)


class Latency(NamedTuple):
    """Time and memory of one inference."""

    median_ms: float
    peak_mb: float  # 10⁶ bytes held at once: weights, inputs, and whatever inference allocates through torch on top of them


def count(model: torch.nn.Module, *inputs: torch.Tensor, **options: Any) -> Cost:
    """Count parameters and multiply-accumulates of `model(*inputs, **options)` in eval mode; of inputs only the size matters.

    The forward of a copy runs on the meta device, which computes shapes only, so it takes no time and no memory. `FlopCounterMode` counts
    two operations a multiply-accumulate, so its sum is halved: a 3→8 convolution of 3×3 on 16×16 pixels is 55,296.
    """
    shapes = copy.deepcopy(model).to("meta").eval()
    with torch.no_grad(), FlopCounterMode(display=False) as counter:
        shapes(*(value.to("meta") for value in inputs), **options)
    return Cost(sum(parameter.numel() for parameter in model.parameters()), counter.get_total_flops() // 2)


def latency(model: torch.nn.Module, *inputs: torch.Tensor, repeats: int = 10, precision: Precision = "float32", **options: Any) -> Latency:
    """Time and memory of `model(*inputs, **options)` in eval mode, in which it stays, on the device of its inputs.

    The median of `repeats` timed runs counts; one before them chooses kernels and fills caches, and its memory is what is measured. `bf16`
    runs under autocast, with the weights in float32.
    """
    device = inputs[0].device
    os.environ.setdefault("KINETO_LOG_LEVEL", "99")  # torch's profiler would print when it starts and stops

    def run() -> None:
        model(*inputs, **options)
        if device.type == "cuda":
            torch.cuda.synchronize(device)

    model.eval()
    with torch.inference_mode(), torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
        if device.type == "cuda":
            before = torch.cuda.memory_allocated(device)
            torch.cuda.reset_peak_memory_stats(device)
            run()
            extra = torch.cuda.max_memory_allocated(device) - before
        else:  # the highest sum of what torch's profiler saw allocated and freed; libraries' own scratch memory is not in it
            with torch.profiler.profile(activities=[torch.profiler.ProfilerActivity.CPU], profile_memory=True) as profile:
                run()
            changes = (event for event in profile.profiler.kineto_results.events() if event.name() == "[memory]")
            extra = max(itertools.accumulate(e.nbytes() for e in sorted(changes, key=lambda event: event.start_ns())), default=0)
        times = timeit.repeat(run, number=1, repeat=repeats)
    held = sum(value.numel() * value.element_size() for value in (*model.parameters(), *model.buffers(), *inputs))
    return Latency(statistics.median(times) * 1e3, (held + extra) / 1e6)
