"""What makes a result stale: the code that it is made with, by folder; not its comments, and not other code."""

import json
import re

import pytest
from import_graph import ROOT, closure, modules, notebook_imports

from dualdepth import run
from dualdepth.run import CODE, code_digest, notebook_digest

NOTEBOOKS = sorted(path.stem for path in (ROOT / "notebooks").glob("*.ipynb"))
STEPS = dict(re.findall(r'made_from\(\s*"?([\w\[\]]+)"?,\s*"(\w+)"', (ROOT / "Snakefile").read_text(encoding="utf-8")))
"""The step that the Snakefile names with a notebook, or with the expression that stands for several."""
EXEMPT = ("dualdepth", "errors", "files", "settings", "profile", "run")
"""Modules that no step lists though its notebook imports them: names and version, words of messages, how bytes reach the disk (not which),
settings and profiles (their values are compared one by one), where files lie."""
SOURCE = '''"""A module."""

import math


def area(r):
    """Of a circle."""
    return math.pi * r**2  # in square metres
'''


def within(module, parts):
    """Whether a module is one of these folders and modules, or lies in one."""
    path = module.removeprefix("dualdepth.").replace(".", "/")
    return any(path == part or path.startswith(f"{part}/") for part in parts)


def unlisted(start, step, *more):
    """Modules that `start` imports, directly or not, and that neither the step lists nor stand in EXEMPT."""
    found = closure(start, stop=lambda module: within(module, EXEMPT))
    return sorted(module for module in found if not within(module, (*CODE[step], *more)))


@pytest.mark.parametrize("notebook", NOTEBOOKS)
def test_all_code_that_a_notebook_imports_makes_its_step_stale(notebook):
    step = STEPS.get(notebook) or STEPS["NOTEBOOKS[STAGE[variant]]" if "_train_" in notebook else "page"]
    assert unlisted(notebook_imports(notebook), step) == []


def test_all_code_that_shapes_weights_and_scores_stands_in_their_digests():
    assert unlisted(["dualdepth.training.variants"], "training") == []
    scoring = [f"dualdepth.tables.{name}" for name in ("scores", "make3d", "trajectories")]
    assert unlisted(scoring, "predict", "paper") == []  # the paper's rows shape no scores


def test_a_change_in_what_comes_after_them_leaves_data_and_weights_alone():
    after = {"evaluation", "tables", "inference", "model", "report", "paper", "cli", "notebooks"}
    assert not after & {*CODE["data"], *CODE["training"], *CODE["training_page"]} and "tables/plots" not in CODE["training"]


def test_what_is_listed_or_exempt_is_there():
    listed = set().union(*CODE.values())
    assert all(any(within(module, [part]) for module in modules()) for part in {*EXEMPT} | listed) and not {*EXEMPT} & listed


@pytest.fixture
def digest_of(tmp_path, monkeypatch):
    """The digest of a step whose only folder has the given source."""
    monkeypatch.setattr(run, "PACKAGE", tmp_path)
    monkeypatch.setattr(run, "CODE", {"step": ("parts",)})

    def digest(source, name="parts/circle.py"):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(source)
        run._digest.cache_clear()
        return code_digest("step")

    yield digest
    run._digest.cache_clear()


WORDS = [("# in square metres", "# m²"), ("Of a circle.", "Area of a circle of radius r."), ("A module.", "Circles."), ("\n\n\n", "\n")]
LAYOUT = [("math.pi * r**2", "(math.pi\n            * r ** 2)")]
MEANING = [("r**2", "r**3"), ("math.pi", "3.14"), ("area", "surface"), ("(r)", "(r=1)")]


@pytest.mark.parametrize(("old", "new"), [*WORDS, *LAYOUT, *MEANING])
def test_a_change_of_the_code_makes_results_stale_and_comments_docstrings_and_layout_do_not(digest_of, old, new):
    assert old in SOURCE and (digest_of(SOURCE.replace(old, new)) != digest_of(SOURCE)) == ((old, new) in MEANING)


def test_a_new_file_beside_it_makes_results_stale(digest_of):
    before = digest_of(SOURCE)
    assert digest_of("def length(r): return r\n", "parts/length.py") != before


def test_a_notebooks_digest_is_blind_to_its_outputs(tmp_path):
    def digest(source, outputs):
        cell = {"cell_type": "code", "source": source, "outputs": outputs, "metadata": {}}
        (tmp_path / "00_a.ipynb").write_text(json.dumps({"cells": [{"cell_type": "markdown", "source": str(outputs)}, cell]}))
        return notebook_digest(tmp_path / "00_a.ipynb")

    before = digest(["x = 1\n", "x"], [])
    assert digest(["x = 1\n", "x"], [{"text": "1"}]) == digest("x = 1\nx", []) == before
    assert digest(["x = 2\n", "x"], []) != before
