"""Write docs/settings.md: every setting of a profile with its type, its default and what its docstring says."""

import ast
import inspect
import json
import textwrap
import typing
from pathlib import Path

from pydantic import BaseModel
from pydantic.fields import FieldInfo

from dualdepth.profile import PROFILES, Profile, load_profile
from dualdepth.settings import Variant

KINDS = {"int": "whole number", "float": "number", "bool": "true or false", "str": "text"}
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
    about, meanings = " ".join(inspect.cleandoc(model.__doc__ or "").split()), _meanings(model)
    lines, inner = ["", f"## {title}", "", about, "", "| setting | values | default | meaning |", "|---|---|---|---|"], []
    for name, field in model.model_fields.items():
        section = next((t for t in (field.annotation, *typing.get_args(field.annotation)) if _is_section(t)), None)
        if section and section is not Variant:
            inner += _section(section, f"{prefix}{name}.")
        needed = field.is_required() or (section and field.default is not None)
        default = "" if needed else f"`{field.default if isinstance(field.default, str) else json.dumps(field.default)}`"
        values = "a section, below" if section and section is not Variant else _values(field)
        lines.append(f"| `{prefix}{name}` | {values} | {default} | {meanings.get(name, '')} |")
    return lines + inner


def _is_section(kind: object) -> bool:
    return inspect.isclass(kind) and issubclass(kind, BaseModel)


def _values(field: FieldInfo) -> str:
    """The choices or the type of a setting, with its limits."""
    if typing.get_origin(field.annotation) is typing.Literal:
        return ", ".join(f"`{choice}`" for choice in typing.get_args(field.annotation))
    kind = KINDS.get(getattr(field.annotation, "__name__", ""), "")
    signs = {"ge": "≥", "gt": ">", "le": "≤", "lt": "<"}
    limits = [f"{sign} {getattr(part, name)}" for part in field.metadata for name, sign in signs.items() if hasattr(part, name)]
    return ", ".join([*([kind] if kind else []), *limits])


def _meanings(model: type[BaseModel]) -> dict[str, str]:
    """What stands below each field, or behind it as a comment."""
    source = textwrap.dedent(inspect.getsource(model))
    lines, body = source.splitlines(), ast.parse(source).body[0].body
    meanings = {}
    for field, below in zip(body, [*body[1:], None]):
        if isinstance(field, ast.AnnAssign):
            comment = lines[field.end_lineno - 1][field.end_col_offset :].strip().removeprefix("#").strip()
            told = ast.literal_eval(below.value) if isinstance(below, ast.Expr) else comment
            meanings[field.target.id] = " ".join(told.split()).replace("|", "\\|")
    return meanings


if __name__ == "__main__":
    PAGE.write_text(page(), encoding="utf-8")
