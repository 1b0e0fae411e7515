"""Checkpoints to resume from (torch, `weights_only`) and released weights (safetensors with a JSON card)."""

import hashlib
import json
import warnings
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import nn

from dualdepth.atomic import atomic_path, write_json
from dualdepth.errors import InputError


def save_checkpoint(path: str | Path, *, recipe: str, step: int, model: nn.Module, optimizer: torch.optim.Optimizer) -> None:
    """Write what a resume needs, atomically: the file before stays until the new one is whole and reads back."""
    state = {"recipe": recipe, "step": step, "model": model.state_dict(), "optimizer": optimizer.state_dict()}
    with atomic_path(path) as partial:
        torch.save(state, partial)
        torch.load(partial, map_location="cpu", weights_only=True)


def load_checkpoint(path: str | Path) -> dict[str, Any] | None:
    """Read a checkpoint: `recipe`, `step`, `model`, `optimizer`; None where there is no file.

    Raises:
        InputError: the file is truncated, foreign, or holds anything but tensors and plain values (its code is not run).
    """
    path = Path(path)
    if not path.exists():
        return None
    try:
        with warnings.catch_warnings(action="ignore"):  # of a foreign file, which the error below tells of
            state = torch.load(path, map_location="cpu", weights_only=True)
        if {"recipe", "step", "model", "optimizer"} <= set(state):
            return state
        reason = "keys are missing"
    except Exception as error:  # torch, pickle and zip have a kind for each damage
        reason = (str(error) or type(error).__name__).splitlines()[0]
    raise InputError(f"{path}: not a checkpoint of this project ({reason}); delete it to train from the start")


def save_weights(path: str | Path, model: nn.Module, card: dict[str, Any]) -> None:
    """Write weights as safetensors and beside them `<name>.json`, the card, with the weights' sha256 in it.

    The card goes first, so that weights are never there without one.
    """
    path = Path(path)
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in model.state_dict().items()}
    with atomic_path(path) as partial:
        save_file(tensors, partial)
        write_json(path.with_suffix(".json"), card | {"sha256": hashlib.sha256(partial.read_bytes()).hexdigest()})


def load_card(path: str | Path) -> dict[str, Any]:
    """Read the card of a weights file.

    Raises:
        InputError: there is none, or it is not JSON.
    """
    card = Path(path).with_suffix(".json")
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
