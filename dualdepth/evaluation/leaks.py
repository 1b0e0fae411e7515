"""A guard against leaks: no frame is scored whose drive the network was trained on, its ancestors included."""

from collections.abc import Iterable
from typing import Any

from dualdepth.errors import InputError


def check_leak(card: dict[str, Any], drives: Iterable[str], *, allow: bool, weights: Any = "the weights") -> str:
    """Refuse to score frames of `drives` that a training has seen, unless it is allowed; odometry sequences count as their raw drives.

    The card's `drives` are those of the training's ancestors, too. What a result must say comes back: nothing, or the leak by name. An
    `InputError` says that there is a leak that is not allowed, or that the card does not say what was trained on.
    """
    if "drives" not in card:
        raise InputError(f"{weights}: its card does not say which drives it was trained on; keep the card that was written with it")
    shared = sorted(set(card["drives"]) & set(drives))
    if not shared:
        return ""
    if not allow:
        mend = "score other drives, or give --allow-leak (make reproduce ALLOW_LEAK=1), which marks the result"
        raise InputError(f"{weights}: was trained on {', '.join(shared)}, of which frames are to be scored: {mend}")
    return f"LEAK: trained on {', '.join(shared)}"
