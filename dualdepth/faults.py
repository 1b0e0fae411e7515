"""What ends a training before its time: a signal, or numbers that are not finite; and the latter's batch, kept to be looked into."""

import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from torch import Tensor, nn
from torch.utils.data import DataLoader

from dualdepth.atomic import atomic_path
from dualdepth.checkpoints import read_state
from dualdepth.errors import InputError
from dualdepth.precision import Precision

FAILURE_KEYS = {"what", "step", "names", "model", "precision", "images", "intrinsics"}


def one_line_errors(loader: DataLoader) -> Iterator[dict[str, Any]]:
    """The loader's batches; a bad image met by a worker process is told without the worker's traceback."""
    try:
        yield from loader
    except InputError as error:
        raise InputError(str(error).rsplit("InputError: ", 1)[-1].strip()) from None


class StopRequested:
    """Notes SIGTERM (a cluster's notice), so that the loop can write a checkpoint at the end of its step."""

    def __init__(self, accelerator: Accelerator) -> None:
        self.accelerator, self.noted = accelerator, False

    def agreed(self) -> bool:
        """Whether any process was told to stop; all of them ask after each step, so that they stop at the same one."""
        if self.accelerator.num_processes == 1:
            return self.noted
        if self.noted:
            self.accelerator.set_trigger()
        return self.accelerator.check_trigger()

    def __enter__(self) -> "StopRequested":
        try:
            self.before = signal.signal(signal.SIGTERM, self._note)
        except ValueError:  # not the main thread: nobody can send us signals
            self.before = None
        return self

    def _note(self, *_: object) -> None:
        self.noted = True

    def __exit__(self, *_: object) -> None:
        if self.before is not None:
            signal.signal(signal.SIGTERM, self.before)


def write_failure(
    path: Path, what: str, step: int, names: Sequence[str], model: nn.Module, batch: dict[str, Any], precision: Precision
) -> Path:
    """Keep a batch whose loss or gradient was not finite, with the weights that it met.

    Args:
        path: of the file.
        what: was not finite, such as "loss".
        step: which it would have been.
        names: of its triplets.
        model: before the step.
        batch: `images` and `intrinsics` of the last part.
        precision: of the networks.
    """
    state = {"what": what, "step": step, "names": list(names), "model": model.state_dict(), "precision": precision}
    with atomic_path(path) as partial:
        torch.save(state | {key: batch[key].cpu() for key in ("images", "intrinsics")}, partial)
    return path


def load_failure(path: str | Path) -> dict[str, Any]:
    """What `write_failure` kept.

    Raises:
        InputError: there is none, or it cannot be read (its code is not run).
    """
    if not Path(path).exists():
        raise InputError(f"{path}: is not there; it is written when a loss or gradient is not finite")
    return read_state(path, FAILURE_KEYS, "a failure kept by a training", "train again to see whether it comes again")


def replay(state: dict[str, Any], stage: nn.Module) -> list[str]:
    """Compute a kept batch again and say, line by line, where numbers stop being finite.

    Args:
        state: of `load_failure`.
        stage: of that training; is given the weights.

    Raises:
        InputError: the weights are of another network.
    """
    try:
        stage.load_state_dict(state["model"])
    except RuntimeError as error:
        raise InputError(f"the kept weights are of another network ({str(error).splitlines()[1].strip()[:120]})") from None
    lines = [f"step {state['step']}: {state['what']} was not finite", *(f"frame {name}" for name in state["names"])]
    spoilt = [name for name, value in stage.state_dict().items() if not torch.isfinite(value.float()).all()]
    lines.append(f"weights: {_list(spoilt)}")
    batch = {key: state[key] for key in ("images", "intrinsics")}
    lines.append(f"intrinsics: {'finite' if torch.isfinite(batch['intrinsics']).all() else 'NOT finite'}")
    for precision in dict.fromkeys((state["precision"], "float32")):
        stage.train().zero_grad()
        with torch.autocast(batch["images"].device.type, torch.bfloat16, enabled=precision == "bf16"):
            losses = stage(batch).losses
        losses.total.backward()
        values = {name: getattr(losses, name) for name in ("total", "photometric", "smoothness", "feature", "valid_share")}
        lines.append(f"{precision}: " + ", ".join(f"{name} {value.item():.6g}" for name, value in values.items()))
        grads = {name: p.grad for name, p in stage.named_parameters() if p.grad is not None}
        lines.append(f"{precision}: gradients: {_list([name for name, grad in grads.items() if not torch.isfinite(grad).all()])}")
    stage.eval()  # one sample at a time has no batch statistics
    with torch.no_grad():
        for index in range(len(batch["images"])):
            total: Tensor = stage({key: value[index : index + 1] for key, value in batch.items()}).losses.total
            lines.append(f"sample {index} by itself, running statistics: loss {total.item():.6g}")
    return lines


def _list(names: list[str]) -> str:
    shown = ", ".join(names[:5]) + (f" and {len(names) - 5} more" if len(names) > 5 else "")
    return f"NOT finite in {shown}" if names else "finite"
