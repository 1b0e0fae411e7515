"""Checkpoints that a training goes on from (torch, `weights_only`); released weights are in `weights.py`."""

import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

from dualdepth.errors import InputError, reading
from dualdepth.files import atomic_path

KEYS = {"recipe", "parts", "precision", "step", "model", "optimizer"}
"""Digest of all that shapes the result; parts that each batch was cut into, by accumulation and processes together; precision in which the
networks compute; steps done; states of model and optimiser."""


def checkpoint_paths(folder: str | Path) -> list[Path]:
    """A folder's checkpoints, the newest first."""
    return sorted(Path(folder).glob("checkpoint_*.pt"), reverse=True)


def save_checkpoint(folder: str | Path, state: dict[str, Any], keep: int = 2) -> Path:
    """Write what a resume needs, `KEYS`, atomically: written, flushed, read back, renamed. Then all but the newest `keep` are removed.
    An `OSError` says that it could not be written; the checkpoints before it are untouched."""
    path = Path(folder) / f"checkpoint_{state['step']:08d}.pt"
    with atomic_path(path) as partial:
        try:
            torch.save(state, partial)
            _read(partial)
        except (RuntimeError, zipfile.BadZipFile) as error:  # how torch tells of a full disk
            raise OSError(f"{path}: {str(error).splitlines()[0]}") from error
    for old in checkpoint_paths(folder)[keep:]:
        old.unlink(missing_ok=True)
    return path


def _read(path: Path) -> Any:
    """What `torch.save` wrote. It gives each tensor a checksum, which `torch.load` does not look at, but `zipfile` does."""
    with zipfile.ZipFile(path) as archive:
        if damaged := archive.testzip():
            raise zipfile.BadZipFile(f"{damaged} is damaged")
    with warnings.catch_warnings(action="ignore"):  # of a foreign file, which its reader's error tells of
        return torch.load(path, map_location="cpu", weights_only=True)


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint, a dictionary of `KEYS`. An `InputError` says that the file is missing, truncated, changed, foreign, or holds
    anything but tensors and plain values (its code is not run)."""
    with reading(path, "not a checkpoint of this project; delete it to train from the start"):
        state = _read(Path(path))
        if not set(state) >= KEYS:
            raise ValueError("keys are missing")
    return state


def last_checkpoint(folder: str | Path, say: Callable[[str], object] = print) -> dict[str, Any] | None:
    """The newest checkpoint of a folder that can be read; None where there is none. `say` is told of damaged ones.
    An `InputError` says that there are some, and none can be read."""
    damage = None
    for path in checkpoint_paths(folder):
        try:
            return load_checkpoint(path)
        except InputError as error:
            say(f"warning: {error}; trying the one before")
            damage = error
    if damage:
        raise damage
    return None
