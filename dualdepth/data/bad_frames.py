"""Triplets that a training leaves out because a frame of theirs cannot be read: a list on disk, which loader workers share."""

import json
import os
from pathlib import Path

from dualdepth.errors import InputError


class BadFrames:
    """The list, one JSON line `{"triplet", "reason"}` for each.

    Args:
        path: of the list.
        limit: how many there may be.
    """

    def __init__(self, path: Path, limit: int) -> None:
        self.path, self.limit = path, limit

    def reasons(self) -> dict[str, str]:
        """Why, by the triplet's name."""
        if not self.path.exists():
            return {}
        lines = [json.loads(line) for line in self.path.read_text(encoding="utf-8").splitlines()]
        return {line["triplet"]: line["reason"] for line in lines}

    def note(self, triplet: str, reason: str) -> None:
        """Put a triplet on the list, unless it is there.

        Raises:
            InputError: there are more than the limit now.
        """
        known = self.reasons()
        if triplet in known:
            return
        if len(known) >= self.limit:
            raise InputError(f"{reason}; {len(known)} triplets were skipped before it, max_bad_frames is {self.limit} ({self.path})")
        line = json.dumps({"triplet": triplet, "reason": reason}, ensure_ascii=False) + "\n"
        descriptor = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o644)
        try:
            os.write(descriptor, line.encode())  # one write, so that lines of two workers do not mix
        finally:
            os.close(descriptor)

    def clear(self) -> None:
        """Forget all, when a training begins anew."""
        self.path.unlink(missing_ok=True)
