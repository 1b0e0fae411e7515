"""Write docs/settings.md: every setting of a profile with its values, its default and what its docstring says."""

import ast
import inspect
import json
import textwrap
import types
import typing
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from dualdepth.profile import PROFILES, Profile, load_profile
from dualdepth.settings import Variant

KINDS = {int: "whole number", float: "number", bool: "true or false", str: "text", type(None): "null", dict: "mapping", Any: "any"}
UNIONS = (typing.Union, types.UnionType)
PAGE = Path(__file__).parents[1] / "docs" / "settings.md"
INTRODUCTION = """# Profiles and settings

*This page is made from the docstrings of `dualdepth/settings.py` and `dualdepth/profile.py` by `tools/settings_page.py`.*

A profile is a YAML file. `PROFILE=name` takes one that comes with the package, `PROFILE=my.yaml` takes your own. Yours may begin with
`extends: miniature`, and then it holds only what differs. A name such as `training.loss.smoothness` means the key `smoothness` below
`loss` below `training`. An unknown key is an error that names the nearest known one. [Data, profiles and tables](data.md) says
how profiles are used.
"""


def page() -> str:
    """The whole page in Markdown."""
    lines = [INTRODUCTION, "## Profiles that come with the package", "", "| profile | what its numbers are | trains |", "|---|---|---|"]
    for path in sorted(PROFILES.glob("*.yaml")):
        profile = load_profile(path.stem)
        lines.append(f"| `{path.stem}` | {profile.about} | {', '.join(f'`{name}`' for name in profile.train)} |")
    return "\n".join([*lines, *_section(Profile, "")]) + "\n"


def _section(model: type[BaseModel], prefix: str) -> list[str]:
    """Heading and table of a section, then those of the sections in it."""
    title = f"`{prefix.rstrip('.')}`" if prefix else "The profile itself"
    title += ", below the name of each" if model is Variant else ""
    about, meanings = " ".join(inspect.cleandoc(model.__doc__ or "").split()), _meanings(model)
    lines, inner = ["", f"## {title}", "", about, "", "| setting | values | default | meaning |", "|---|---|---|---|"], []
    for name, field in model.model_fields.items():
        section = next((t for t in (field.annotation, *typing.get_args(field.annotation)) if _is_section(t)), None)
        if section:
            inner += _section(section, f"{prefix}{name}.")
        needed = field.is_required() or (section and field.default is not None)
        default = "" if needed else f"`{field.default if isinstance(field.default, str) else json.dumps(field.default)}`"
        values = "a section, below" if section else _values(field)
        lines.append(f"| `{prefix}{name}` | {values} | {default} | {meanings.get(name, '')} |")
    return lines + inner


def _is_section(kind: object) -> bool:
    return inspect.isclass(kind) and issubclass(kind, BaseModel)


def _values(field: FieldInfo) -> str:
    """The choices or the type of a setting, with its limits."""
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    limits = [f"{sign} {getattr(part, name)}" for part in field.metadata for name, sign in signs.items() if hasattr(part, name)]
    return ", ".join([_kind(field.annotation), *limits])


def _kind(annotation: object) -> str:
    """A type in words."""
    origin, parts = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in parts)
    if origin is typing.Annotated:
        return _kind(parts[0])
    words = [_kind(part) for part in parts]
    if origin is list:
        return f"list: {words[0]}"
    return f"[{', '.join(words)}]" if origin is tuple else " or ".join(words) if origin in UNIONS else KINDS[origin or annotation]


def _meanings(model: type[BaseModel]) -> dict[str, str]:
    """What stands below each field, or behind it as a comment."""
    meanings = _meanings(model.__base__) if model.__base__ is not BaseModel else {}
    source = textwrap.dedent(inspect.getsource(model))
    lines, body = source.splitlines(), ast.parse(source).body[0].body
    for field, below in zip(body, [*body[1:], None]):
        if isinstance(field, ast.AnnAssign):
            comment = lines[field.end_lineno - 1][field.end_col_offset :].strip().removeprefix("#").strip()
            told = ast.literal_eval(below.value) if isinstance(below, ast.Expr) else comment
            meanings[field.target.id] = " ".join(told.split()).replace("|", "\\|") or meanings.get(field.target.id, "")
    return meanings


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
