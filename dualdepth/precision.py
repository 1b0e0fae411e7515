"""In which precision the networks compute."""

from typing import Literal

import torch

Precision = Literal["float32", "bf16"]


def has_bf16(device: torch.device) -> bool:
    """Whether a device computes in bfloat16 by itself. A CPU without such instructions imitates them, and takes nine times as long."""
    if device.type == "cuda":
        return torch.cuda.is_bf16_supported(including_emulation=False)
    if device.type == "cpu":
        can = torch.cpu.get_capabilities()
        return any(can.get(name, False) for name in ("avx512_bf16", "amx_bf16"))
    return False


def choose_precision(setting: Literal["auto"] | Precision, device: torch.device, lr_size: tuple[int, int]) -> Precision:
    """What `training.precision` means on a device: `auto` is bf16 where the device has it, else float32.

    Frames of LR-Net of 64×64 and less stay in float32: PoseNet ends in 1×1 maps there, whose bf16 gradients torch 2.13 gets wrong.
    """
    if setting != "auto":
        return setting
    return "bf16" if has_bf16(device) and max(lr_size) > 64 else "float32"
