"""Which machine this is: how many processes share a training, on which device and in which precision it computes, what it is called.

torch is loaded by the functions that need it, since commands that only read files start without it.
"""

import contextlib
import ctypes
import os
import sys
import warnings
from pathlib import Path
from typing import TYPE_CHECKING, Literal, get_args

from dualdepth.errors import InputError

if TYPE_CHECKING:
    import torch

Precision = Literal["float32", "bf16"]


def process_count() -> int:
    """Processes that share one training under `torchrun` or SLURM, 1 where nothing says otherwise."""
    return int(os.environ.get("WORLD_SIZE", 1))


def is_main_process() -> bool:
    """Whether this is the one that writes and prints."""
    return int(os.environ.get("RANK", 0)) == 0


def on_cpu() -> bool:
    """Whether trainings compute on the CPU. Accelerate must be told: else several processes each work alone, or one on Apple's GPU."""
    return default_device().type == "cpu"


def wait_for_everyone() -> None:
    """Go on when all processes have come here."""
    if process_count() > 1:
        from accelerate import PartialState

        PartialState(cpu=on_cpu()).wait_for_everyone()


def default_device() -> "torch.device":
    """Where trainings and tables compute: a CUDA GPU where there is one, else the CPU."""
    import torch

    return choose_device("cuda" if torch.cuda.is_available() else "cpu")


def choose_device(name: "str | torch.device | None") -> "torch.device":
    """The device that a user asks for, or for None a CUDA GPU, Apple's, or the CPU, the first that is there. An `InputError` says that it
    is unknown or not to be had here. From then on the process computes convolutions of float32 in float32, not in TF32."""
    import torch

    torch.backends.cudnn.allow_tf32 = False  # float32 is to be float32, of convolutions, too
    there = ["cpu", *(f"cuda:{i}" for i in range(torch.cuda.device_count())), *["mps"] * torch.backends.mps.is_available()]
    if name is None:
        return torch.device("cuda" if "cuda:0" in there else there[-1])
    if ("cuda:0" if str(name) == "cuda" else str(name)) not in there:
        raise InputError(f"device {str(name)!r} is not to be had; here there are {', '.join(there)}")
    return torch.device(name)


def device_name() -> str:
    """The GPU's name, or the CPU's with the number of threads used; nothing is loaded to find out."""
    torch = sys.modules.get("torch")
    if torch and torch.cuda.is_available():
        return torch.cuda.get_device_name()
    information = Path("/proc/cpuinfo").read_text(encoding="utf-8") if Path("/proc/cpuinfo").exists() else ""
    models = [line.partition(":")[2].strip() for line in information.splitlines() if line.startswith("model name")]
    threads = torch.get_num_threads() if torch else os.cpu_count()
    return f"{models[0] if models else 'CPU'}, {threads} thread{'s' * (threads != 1)}"


def has_bf16(device: "torch.device") -> bool:
    """Whether a device computes in bfloat16 by itself. A CPU without such instructions imitates them, and takes nine times as long."""
    import torch

    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    return device.type == "cpu" and any(torch.cpu.get_capabilities().get(name) for name in ("avx512_bf16", "amx_bf16"))


def choose_precision(setting: Literal["auto"] | Precision, device: "torch.device", lr_size: tuple[int, int]) -> Precision:
    """What `training.precision` means on a device: `auto` is bf16 where the device computes in it, else float32.

    Frames of LR-Net of 64×64 and less stay in float32: PoseNet ends in 1×1 maps there, whose bf16 gradients torch 2.13 gets wrong.
    `lr_size` is their (height, width).
    """
    if setting != "auto":
        return setting
    return "bf16" if has_bf16(device) and max(lr_size) > 64 else "float32"


def inference_precision(precision: str | None, device: "torch.device") -> Precision:
    """The precision that a user asks for, an `InputError` if it is unknown; for None bf16 on a CUDA GPU that has it, else float32."""
    if precision is None:
        return "bf16" if device.type == "cuda" and has_bf16(device) else "float32"
    if precision not in get_args(Precision):
        raise InputError(f"precision {precision!r} is unknown: choose one of {', '.join(get_args(Precision))}")
    return precision


def compute_repeatably(repeatably: bool = True) -> None:
    """Have torch take algorithms that give the same bits each time, or let it take any, for the rest of the process."""
    import torch

    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # else cuBLAS is free to choose
    torch.use_deterministic_algorithms(repeatably, warn_only=True)
    # a pass over every new tensor, of which none is read before it is written
    torch.utils.deterministic.fill_uninitialized_memory = False
    # torch warns of all of an operation; of these only what is repeatable is used: gradients of coordinates, medians without their places
    warnings.filterwarnings("ignore", "(grid_sampler_2d_backward_cuda|median CUDA) .*deterministic")


def keep_freed_memory() -> None:
    """Keep freed memory in this process, for tensors on the CPU, where the allocator is glibc's.

    glibc gives every large tensor back to the system when it is freed, and the next one of that size is paged in and zeroed anew: a third
    of a training step at high resolution, for some more memory in use. Numbers do not change.
    """
    with contextlib.suppress(OSError, AttributeError):  # another system's library
        mallopt = ctypes.CDLL("libc.so.6").mallopt
        mallopt(-4, 0)  # M_MMAP_MAX: no tensor gets a mapping of its own
        mallopt(-1, -1)  # M_TRIM_THRESHOLD: nothing is given back
        mallopt(-2, 1 << 26)  # M_TOP_PAD: bytes that the heap grows by at least
