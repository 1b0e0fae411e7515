"""Commands as README, CONTRIBUTING and docs/ print them: found, taken apart, parsed by the real parsers, run on small data."""

import argparse
import importlib
import re
import shlex
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import pytest

from dualdepth.cli import EXAMPLES

REPOSITORY = Path(__file__).parents[1]
PAGES = [REPOSITORY / "README.md", REPOSITORY / "CONTRIBUTING.md", *sorted((REPOSITORY / "docs").glob("*.md"))]
SHELL = ("bash", "sh", "shell", "console")
PROGRAMS = ("dualdepth", "make", "python", "torchrun", "srun", "pip", ".")
"""First words that make a line of a fence without language a command."""


class Command(NamedTuple):
    """A command and where it stands."""

    page: str
    text: str

    @property
    def words(self) -> list[str]:
        """Its words, without comment and without settings of the environment in front."""
        try:
            words = shlex.split(self.text, comments=True)
        except ValueError:  # an open quotation mark: no command
            return []
        return words[next((i for i, w in enumerate(words) if not re.fullmatch(r"\w+=.*", w)), len(words)) :]


def fences(page: Path) -> Iterator[tuple[str, str]]:
    """(language, content) of a page's code fences."""
    for match in re.finditer(r"^```(\w*)\n(.*?)^```", page.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL):
        yield match[1], match[2]


def prose(page: Path) -> str:
    """A page without its code fences."""
    return re.sub(r"^```.*?^```", "", page.read_text(encoding="utf-8"), flags=re.MULTILINE | re.DOTALL)


def inline_code(page: Path) -> list[str]:
    """What stands between backticks in a page's prose."""
    return [" ".join(code.split()) for code in re.findall(r"`([^`]+)`", prose(page))]


def fenced_commands() -> list[Command]:
    """Every command of a fence: all lines of a shell's, and those that begin with a known program of one without language; and each
    example of a `--help`."""
    found = []
    for page in PAGES:
        for language, content in fences(page):
            for line in content.replace("\\\n", " ").splitlines():
                for text in line.split(" && "):
                    command = Command(page.name, text.strip())
                    if command.words and (language in SHELL or (not language and command.words[0] in PROGRAMS)):
                        found.append(command)
    return found + [Command(f"{program} --help", text) for program, examples in EXAMPLES.items() for text in examples]


def inline_commands() -> list[Command]:
    """Every command in prose; one that names no option is read as the mention of it."""
    programs = ("dualdepth ", "make ", "python data_scripts/", "python -m ")
    parts = [(page.name, part.strip()) for page in PAGES for code in inline_code(page) for part in code.split(" && ")]
    return [Command(page, part) for page, part in dict.fromkeys(parts) if part.startswith(programs)]


class ParsedError(BaseException):
    """Raised in place of running what was parsed."""


def program(words: list[str]) -> tuple[Callable[[list[str]], int | None], list[str]]:
    """`main` and arguments of a command of this project: `dualdepth …`, `python data_scripts/x.py …`, `python -m dualdepth.x …`."""
    if words[0] == "dualdepth":
        return importlib.import_module("dualdepth.cli").main, words[1:]
    if words[:2] == ["python", "-m"]:
        return importlib.import_module(words[2]).main, words[3:]
    assert words[0] == "python" and (REPOSITORY / words[1]).is_file(), f"{words[:2]} is no program of this project"
    return importlib.import_module(words[1].removesuffix(".py").replace("/", ".")).main, words[2:]


def dry_program(words: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    """Parse the options by the program's own parser, and do nothing else."""
    (main, arguments), parse = program(words), argparse.ArgumentParser.parse_args

    def only_parse(self: argparse.ArgumentParser, *given: object) -> None:
        parse(self, *given)
        raise ParsedError

    with monkeypatch.context() as patch, pytest.raises((ParsedError, SystemExit)) as end:
        patch.setattr(argparse.ArgumentParser, "parse_args", only_parse)
        main(arguments)
    assert end.type is ParsedError or ("--help" in arguments and end.value.code == 0)
    if "--" in arguments and "--profile" in (rest := arguments[arguments.index("--") :]):
        assert (REPOSITORY / rest[rest.index("--profile") + 1] / "config.yaml").is_file()


def dry_make(words: list[str], _monkeypatch) -> None:
    """Ask make what it would do, and look for variables that the Makefile does not know."""
    known = set(re.findall(r"\$\((?:call quoted,)?(\w+)\)", (REPOSITORY / "Makefile").read_text(encoding="utf-8")))
    variables = {word.partition("=")[0] for word in words[1:] if "=" in word}
    assert variables <= known, f"the Makefile knows no {variables - known}"
    done = subprocess.run(["make", "-n", *words[1:]], cwd=REPOSITORY, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def dry_pytest(words: list[str], _monkeypatch) -> None:
    """Paths and markers of a `python -m pytest` are there."""
    options = words[3:]
    marker = options[options.index("-m") + 1] if "-m" in options else None
    assert marker is None or f'"{marker.removeprefix("not ")}:' in (REPOSITORY / "pyproject.toml").read_text(encoding="utf-8")
    assert all((REPOSITORY / word).exists() for word in options if not word.startswith("-") and word != marker)


def dry_torchrun(words: list[str], monkeypatch) -> None:
    """Parse torchrun's options by its own parser, and what it starts by ours; what stands before it is the cluster's."""
    from torch.distributed.run import get_args_parser

    words = words[words.index("torchrun") + 1 :]
    place = words.index("-m")
    assert words[place + 1] == "dualdepth.cli"
    get_args_parser().parse_args(words)
    dry_program(["dualdepth", *words[place + 2 :]], monkeypatch)


def trust(_words: list[str], _monkeypatch) -> None:
    """Nothing to check: another program's command."""
