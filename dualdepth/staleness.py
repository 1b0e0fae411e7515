"""What a step of the chain is made from beside its input files: code by folder, its notebook, settings, what a user gave.

Snakemake notes each of them with a step's outputs, makes the step anew when one differs, and names it in a dry run (`make status`).
"""

import ast
import functools
import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from dualdepth.files import short_digest

PACKAGE = Path(__file__).parent
NETWORKS = ("networks", "geometry", "training", "data", "device")
SCORES = (*NETWORKS, "model", "evaluation", "tables")
TABLES = (*SCORES, "plots", "paper")
CODE = {
    "data": ("data_scripts", "data", "geometry", "plots"),
    "training": (*NETWORKS, "losses"),
    "training_page": (*NETWORKS, "losses", "plots"),
    "predict": SCORES,
    "tables": TABLES,
    "report": (*TABLES, "report"),
    "quickstart": (*TABLES, "data_scripts"),
}
"""Folders and modules of `dualdepth`, and the folder `data_scripts`, whose code shapes a result; a change in one makes it stale.

`training` is what a training's weights are of, `predict` the scores kept beside them; the others are of steps of the chain.
"""
EXEMPT = {
    "dualdepth": "names and version",
    "errors": "words of messages",
    "files": "how bytes reach the disk, not which",
    "settings": "their values are compared one by one",
    "profile": "its values are compared one by one",
    "run": "where files lie, and stamps",
    "staleness": "this module",
}
"""Modules that no step lists though its notebook imports them, and why a change in them makes nothing stale."""


def inputs(notebook: str, step: str, root: Path, **kinds: Mapping[str, Any]) -> list[tuple[str, Any]]:
    """All that shapes a step's result beside its input files, as (name, value), such as `("code losses", digest)`.

    Args:
        notebook, step: the step's notebook, and a key of `CODE`.
        root: of the checkout.
        kinds: more, such as `setting={"evaluation": {"crop": "eigen"}}`, which gives `("setting evaluation.crop", "eigen")`.
    """
    code = {part: _digest(part) for part in CODE[step]}
    named = {"notebook": {notebook: notebook_digest(root / "notebooks" / f"{notebook}.ipynb")}, "code": code, **kinds}
    return [(f"{kind} {name}", value) for kind, values in named.items() for name, value in _leaves(values)]


def code_digest(step: str) -> str:
    """Digest of the code that shapes a step's result, blind to comments, docstrings and layout."""
    return short_digest(*map(_digest, CODE[step]))


@functools.cache
def _digest(part: str) -> str:
    path = PACKAGE.parent / part if part == "data_scripts" else PACKAGE / part
    files = sorted(path.rglob("*.py")) if path.is_dir() else [path.with_suffix(".py")]
    return short_digest(*(_meaning(file.read_text(encoding="utf-8")) for file in files))


def notebook_digest(path: Path) -> str:
    """Digest of a notebook's code, blind to its prose and outputs."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    return short_digest(json.dumps(["".join(cell["source"]) for cell in cells if cell["cell_type"] == "code"]))


def _meaning(source: str) -> str:
    """The syntax tree without the strings that stand alone."""
    tree = ast.parse(source)
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef):
            node.body = [s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))]
    return ast.dump(tree)


def _leaves(values: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    for name, value in values.items():
        if isinstance(value, Mapping) and value:
            yield from _leaves(value, f"{prefix}{name}.")
        else:
            yield f"{prefix}{name}", value
