"""Checkpoints to resume from (torch, `weights_only`) and released weights (safetensors with a JSON card)."""

import hashlib
import json
import time
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from dualdepth.atomic import atomic_path, write_json
from dualdepth.errors import InputError
from dualdepth.precision import Precision

HUB_CARD = "config.json"
KEYS = {"recipe", "parts", "step", "model", "optimizer"}


def checkpoint_path(folder: str | Path, step: int) -> Path:
    """File of a checkpoint."""
    return Path(folder) / f"checkpoint_{step:08d}.pt"


def checkpoint_paths(folder: str | Path) -> list[Path]:
    """A folder's checkpoints, the newest first."""
    return sorted(Path(folder).glob("checkpoint_*.pt"), reverse=True)


def save_checkpoint(
    folder: str | Path,
    step: int,
    model: nn.Module,
    optimizer: torch.optim.Optimizer,
    *,
    recipe: str,
    parts: int = 1,
    precision: Precision = "float32",
    keep: int = 2,
) -> Path:
    """Write what a resume needs, atomically: written, flushed, read back, renamed. Then all but the newest `keep` are removed.

    Args:
        folder: of the training.
        step: steps done.
        model: that is trained.
        optimizer: of it.
        recipe: digest of all that shapes the result.
        parts: that each batch was cut into, by accumulation and processes together.
        precision: in which the networks compute.
        keep: how many are kept.

    Raises:
        OSError: it could not be written; the checkpoints before it are untouched.
    """
    path = checkpoint_path(folder, step)
    state = {"recipe": recipe, "parts": parts, "precision": precision, "step": step}
    state |= {"model": model.state_dict(), "optimizer": optimizer.state_dict()}
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


def read_state(path: str | Path, keys: set[str], what: str, mend: str) -> dict[str, Any]:
    """Read a file that `torch.save` wrote, and make sure that it holds `keys`.

    Raises:
        InputError: the file is missing, truncated, changed, foreign, or holds anything but tensors and plain values (its code is not
            run); the message says that it is not `what`, and the `mend`.
    """
    path = Path(path)
    try:
        state = _read(path)
        if set(state) >= keys:
            return state
        reason = "keys are missing"
    except Exception as error:  # torch, pickle and zip have a kind for each damage
        reason = (str(error) or type(error).__name__).splitlines()[0]
    raise InputError(f"{path}: not {what} of this project ({reason}); {mend}")


def load_checkpoint(path: str | Path) -> dict[str, Any]:
    """Read a checkpoint: `recipe`, `parts`, `precision`, `step`, `model`, `optimizer`.

    Raises:
        InputError: see `read_state`.
    """
    # one that has no precision is from before that was kept, and so of another recipe, which is not resumed
    return {"precision": "float32"} | read_state(path, KEYS, "a checkpoint", "delete it to train from the start")


def last_checkpoint(folder: str | Path, say: Callable[[str], object] = print) -> dict[str, Any] | None:
    """The newest checkpoint of a folder that can be read; None where there is none. `say` is told of damaged ones.

    Raises:
        InputError: there are some, and none can be read.
    """
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


class Checkpointer:
    """When a training's checkpoints are due, and what becomes of one that cannot be written: a warning, since the training is worth more.

    Args:
        folder: of the training.
        steps: between checkpoints.
        minutes: between checkpoints, where steps are slow.
        keep: how many are kept.
        say: is told of one that could not be written.
    """

    def __init__(self, folder: Path, steps: int, minutes: float, keep: int, say: Callable[[str], object]) -> None:
        self.folder, self.steps, self.minutes, self.keep, self.say = folder, steps, minutes, keep, say
        self.last = time.monotonic()

    def due(self, step: int) -> bool:
        """Whether it is time."""
        return step % self.steps == 0 or time.monotonic() - self.last > 60 * self.minutes

    def save(self, step: int, model: nn.Module, optimizer: torch.optim.Optimizer, *, recipe: str, parts: int, precision: Precision) -> None:
        """Write one; if that fails, say so, and the next is tried in its time."""
        self.last = time.monotonic()
        try:
            save_checkpoint(self.folder, step, model, optimizer, recipe=recipe, parts=parts, precision=precision, keep=self.keep)
        except OSError as error:
            before = checkpoint_paths(self.folder)
            kept = f"the last good one is {before[0].name}" if before else "there is none yet"
            self.say(f"warning: checkpoint of step {step} was not written ({error}); {kept}, training goes on")


def save_weights(path: str | Path, model: nn.Module, card: dict[str, Any], card_name: str | None = None) -> None:
    """Write weights as safetensors and beside them `<name>.json`, or `card_name`, the card, with the weights' sha256 in it.

    The card goes first, so that weights are never there without one.

    Raises:
        InputError: they could not be written.
    """
    path = Path(path)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    try:
        with atomic_path(path) as partial:
            save_file(tensors, partial)
            beside = path.with_name(card_name or f"{path.stem}.json")
            write_json(beside, card | {"sha256": hashlib.sha256(partial.read_bytes()).hexdigest()})
            partial.chmod(beside.stat().st_mode)  # safetensors keeps its files from all others
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: could not be written ({error}); free space, then the same command goes on from the checkpoint") from None


def load_card(path: str | Path) -> dict[str, Any]:
    """Read the card of a weights file: `<name>.json` beside it, or else `config.json`, as the model hub has it.

    Raises:
        InputError: there is none, or it is not JSON.
    """
    card = Path(path).with_suffix(".json")
    if not card.exists() and card.with_name(HUB_CARD).exists():
        card = card.with_name(HUB_CARD)
    try:
        values = json.loads(card.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError(f"expected a mapping, found {type(values).__name__}")
        drives = values.get("drives", [])
        if not (isinstance(drives, list) and all(isinstance(drive, str) for drive in drives)):
            raise ValueError("its drives are no list of names")
        return values
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{card}: the weights' card cannot be read ({error}); keep it beside the weights") from None


def finished_card(path: str | Path) -> dict[str, Any] | None:
    """The card of weights that are there and are those that it was written with; None of a save that was killed between card and weights.

    Raises:
        InputError: there are weights without a readable card.
    """
    path = Path(path)
    if not path.exists():
        return None
    card = load_card(path)
    return card if hashlib.sha256(path.read_bytes()).hexdigest() == card.get("sha256") else None


def load_weights(path: str | Path, model: nn.Module, prefix: str = "") -> dict[str, Any]:
    """Fill `model` with released weights, and return their card.

    Args:
        path: the safetensors file; its card lies beside it.
        model: takes the tensors whose names begin with `prefix`, without it.
        prefix: of the part to load, such as `depth_net.`.

    Raises:
        InputError: the file is missing, truncated, changed since its card was written, or of another network.
    """
    path = Path(path)
    card = load_card(path)
    try:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        tensors = load_file(path)
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read as safetensors ({error}); train again or copy it again") from None
    if digest != card.get("sha256"):
        raise InputError(
            f"{path}: sha256 {digest[:12]}… is not the card's {str(card.get('sha256'))[:12]}…; the file was changed, copy it again"
        )
    try:
        model.load_state_dict({name.removeprefix(prefix): t for name, t in tensors.items() if name.startswith(prefix)})
    except RuntimeError as error:
        raise InputError(
            f"{path}: weights of another network ({str(error).splitlines()[1].strip()[:120]}); check the profile's encoder"
        ) from None
    return card
