"""What a step of the chain is made from, by name, so that `dualdepth status` can say in words what changed."""

import functools
from collections.abc import Iterator, Mapping
from typing import Any

from dualdepth.results import code_digests, notebook_digest

HASHED = ("code", "notebook", "files")
"""Kinds of ingredients of which only a digest is kept: their two values say nothing to a reader."""


def ingredients(notebook: str, code: tuple[str, ...], **kinds: Mapping[str, Any]) -> dict[str, Any]:
    """All that shapes a step's result beside its input files: `{"notebook 05_table_main": digest, "code losses": digest, …}`.

    Args:
        notebook: the step's notebook.
        code: names of `results.CODE`.
        kinds: more, such as `setting={"evaluation": {"crop": "eigen"}}`, which gives `"setting evaluation.crop": "eigen"`.
    """
    named = {"notebook": {notebook: notebook_digest(notebook)}, "code": _code(*code), **kinds}
    return {f"{kind} {name}": value for kind, values in named.items() for name, value in _leaves(values)}


def changes(old: Mapping[str, Any], new: Mapping[str, Any]) -> list[str]:
    """What differs between two results of `ingredients`, in words."""
    words = []
    for name in dict.fromkeys([*new, *old]):
        before, now = old.get(name), new.get(name)
        if before != now:
            words.append(f"{name} changed" if name.startswith(HASHED) else f"{name}: {_shown(before)} → {_shown(now)}")
    return words


_code = functools.cache(code_digests)  # a Snakefile asks for each of its jobs


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value


def _shown(value: Any) -> str:
    return "none" if value in (None, "", {}, []) else str(value)
