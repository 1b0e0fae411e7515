"""Released weights: safetensors, and beside them a JSON card that says what they are and what they learned from."""

import json
from pathlib import Path
from typing import Any

from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from dualdepth.errors import InputError, reading
from dualdepth.files import atomic_path, file_digest, write_json

HUB_CARD = "config.json"


def save_weights(path: str | Path, model: nn.Module | dict[str, Tensor], card: dict[str, Any], card_name: str | None = None) -> None:
    """Write weights as safetensors and beside them `<name>.json`, or `card_name`, the card, with the weights' sha256 in it.

    The card goes first, so that weights are never there without one. An `InputError` says that they could not be written."""
    path = Path(path)
    tensors = model.state_dict() if isinstance(model, nn.Module) else model
    tensors = {name: tensor.detach().cpu().contiguous() for name, tensor in tensors.items()}
    try:
        with atomic_path(path) as partial:
            save_file(tensors, partial)
            beside = path.with_name(card_name or f"{path.stem}.json")
            write_json(beside, card | {"sha256": file_digest(partial)})
            partial.chmod(beside.stat().st_mode)  # safetensors keeps its files from all others
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: could not be written ({error}); free space, then the same command goes on from the checkpoint") from None


def load_card(path: str | Path) -> dict[str, Any]:
    """Read the card of a weights file: `<name>.json` beside it or `config.json`, as the hub has it; of a link, beside the file itself, too.
    A folder stands for its `model.safetensors`. An `InputError` says that there is none, or no weights either, or that it is not JSON."""
    path = Path(path, "model.safetensors") if Path(path).is_dir() else Path(path)
    there = path.exists()
    places = [file for place in (path, path.resolve()) for file in (place.with_suffix(".json"), place.with_name(HUB_CARD))]
    card = next((file for file in places if file.exists()), places[0] if there else path)
    with reading(card, "keep the weights' card beside them, if they are this project's" if there else "give the weights of a training"):
        values = json.loads(card.read_text(encoding="utf-8"))
        if not isinstance(values, dict):
            raise ValueError(f"expected a mapping, found {type(values).__name__}")
        drives = values.get("drives", [])
        if not (isinstance(drives, list) and all(isinstance(drive, str) for drive in drives)):
            raise ValueError("its drives are no list of names")
    return values


def finished_card(path: str | Path) -> dict[str, Any] | None:
    """The card of weights that are there and are those that it was written with; None of a save that was killed between card and weights.
    An `InputError` says that there are weights without a readable card."""
    digest = file_digest(Path(path))
    card = load_card(path) if digest else {}
    return card if digest and digest == card.get("sha256") else None


def load_weights(path: str | Path, model: nn.Module, prefix: str = "") -> dict[str, Any]:
    """Fill `model` with released weights, a file with its card beside it, and return their card. Large tensors
    may be whole numbers of 8 bits, times the step sizes `<name>.step`.

    The model takes the tensors whose names begin with the prefix, such as `depth_net.`, without it. An `InputError` says that the file is
    missing, truncated, changed since its card was written, or of another network."""
    card = load_card(path)
    with reading(path, "train again or copy it again"):
        digest, tensors = file_digest(Path(path)), load_file(path)
    if digest != (told := card.get("sha256")):
        raise InputError(f"{path}: sha256 {digest[:12]}… is not the card's {str(told)[:12]}…; the file was changed, copy it again")
    steps = {name.removesuffix(".step"): tensors.pop(name) for name in [*tensors] if name.endswith(".step")}
    try:
        whole = {name: tensor * steps[name] if name in steps else tensor for name, tensor in tensors.items()}
        model.load_state_dict({name.removeprefix(prefix): t for name, t in whole.items() if name.startswith(prefix)})
    except RuntimeError as error:
        reason = str(error).splitlines()[1].strip()[:120]
        raise InputError(f"{path}: weights of another network ({reason}); check the profile's encoder") from None
    return card
