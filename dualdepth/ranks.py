"""How many processes share one training under `torchrun` or SLURM, and which of them this is."""

import os

import torch


def count() -> int:
    """Processes that work together, 1 where nothing says otherwise."""
    return int(os.environ.get("WORLD_SIZE", 1))


def is_main() -> bool:
    """Whether this is the one that writes and prints."""
    return int(os.environ.get("RANK", 0)) == 0


def on_cpu() -> bool:
    """Whether several processes work on a CPU: accelerate must be told, else each would work by itself."""
    return count() > 1 and not torch.cuda.is_available()


def wait_for_all() -> None:
    """Go on when all processes have come here."""
    if count() > 1:
        from accelerate import PartialState

        PartialState(cpu=on_cpu()).wait_for_everyone()
