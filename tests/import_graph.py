"""Who imports whom, read from the source: also what a function imports only when it is called."""

import ast
import functools
import json
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from dualdepth.run import project_root

ROOT = project_root()
PACKAGES = ("dualdepth", "data_scripts", "tools")


@functools.cache
def modules() -> dict[str, Path]:
    """All modules of the package, of `data_scripts` and of `tools`, by name."""
    files = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
    return {".".join(path.relative_to(ROOT).with_suffix("").parts).removesuffix(".__init__"): path for path in files}


def named(source: str) -> Iterator[str]:
    """Those of our modules that a source imports; of `from a import b` the module `a.b`, if there is one, else `a`."""
    ours = modules()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import):
            # its public names come from `model`, when they are asked for
            names = [name for alias in node.names for name in (alias.name, *["dualdepth.model"] * (alias.name == "dualdepth"))]
        elif isinstance(node, ast.ImportFrom):
            names = [name if (name := f"{node.module}.{alias.name}") in ours else node.module for alias in node.names]
        else:
            continue
        yield from (name for name in names if name in ours)


@functools.cache
def imports_of(module: str) -> frozenset[str]:
    """Those of our modules that one of them imports."""
    return frozenset(named(modules()[module].read_text(encoding="utf-8")))


def notebook_imports(notebook: str) -> set[str]:
    """Those that a committed notebook imports."""
    cells = json.loads((ROOT / "notebooks" / f"{notebook}.ipynb").read_text(encoding="utf-8"))["cells"]
    return {name for cell in cells if cell["cell_type"] == "code" for name in named("".join(cell["source"]))}


def closure(start: Iterable[str], stop: Callable[[str], bool] = lambda module: False) -> set[str]:
    """`start` and all that it imports, directly or not; what `stop` is true of is left out, with what only it imports."""
    found, left = set(), list(start)
    while left:
        module = left.pop()
        if module not in found and not stop(module):
            found.add(module)
            left.extend(imports_of(module))
    return found
