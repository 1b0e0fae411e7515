"""Notebooks run in JupyterLab as a person runs them; `python -m tests.lab` does this with the project's own."""

import nbformat
import pytest
from nbformat.v4 import new_code_cell, new_markdown_cell, new_notebook

from tests import browser
from tests.lab import faults, lab, run_all, shows

pytestmark = [pytest.mark.slow, pytest.mark.skipif(not browser.available(), reason="no chromium with chromedriver here")]

KERNEL = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}}
"""Else JupyterLab asks which one."""


@pytest.fixture(scope="module")
def cells(tmp_path_factory):
    """What each notebook shows after Run All, by name."""
    folder = tmp_path_factory.mktemp("lab")
    table = new_code_cell("import pandas as pd\npd.DataFrame({'abs_rel': [0.1]})")
    picture = new_code_cell(
        "from dualdepth import plots\nimport numpy as np\nplots.depth_pair(np.zeros((9, 9, 3), np.uint8), np.ones((9, 9)), 'a', 'b')"
    )
    notebooks = {"good": [new_markdown_cell("# A page"), table, picture], "bad": [new_code_cell("1 / 0"), new_code_cell("'never'")]}
    for name, content in notebooks.items():
        nbformat.write(new_notebook(cells=content, metadata=KERNEL), folder / f"{name}.ipynb")
    with lab(folder) as address, browser.Browser(folder / ".browser") as window:
        return {name: run_all(window, address(f"{name}.ipynb"), 120) for name in notebooks}


def test_a_page_is_run_and_its_table_and_picture_are_seen(cells):
    assert faults(cells["good"]) == []
    assert (shows(cells["good"], "<table"), shows(cells["good"], "image/png")) == (1, 1)


def test_an_error_and_what_was_not_run_for_it_are_told(cells):
    assert faults(cells["bad"]) == ["ZeroDivisionError: division by zero", "not run: 'never'"]
