"""The notebooks as they are committed: tagged, executed, and really compared by nbval."""

import re

import nbformat
import pytest

from dualdepth.run import project_root

NOTEBOOKS = sorted((project_root() / "notebooks").glob("*.ipynb"))
UNCHECKED = "nbval-ignore-output"


@pytest.fixture(params=NOTEBOOKS, ids=lambda path: path.stem)
def notebook(request):
    return nbformat.read(request.param, as_version=4)


def code_cells(notebook):
    return [cell for cell in notebook.cells if cell.cell_type == "code"]


def test_it_has_one_parameters_cell_whose_first_parameter_is_the_profile(notebook):
    tagged = [cell for cell in code_cells(notebook) if "parameters" in cell.metadata.get("tags", [])]
    assert len(tagged) == 1
    assert tagged[0].source.startswith('profile = "tiny"')


def test_every_code_cell_was_executed_and_none_failed(notebook):
    # nbval never compares a cell without an execution count
    assert all(cell.execution_count for cell in code_cells(notebook))
    assert not [o for cell in code_cells(notebook) for o in cell.outputs if o.output_type == "error"]


def test_it_has_cells_whose_output_is_compared_and_pictures_and_progress_are_in_others(notebook):
    compared = [cell for cell in code_cells(notebook) if cell.outputs and UNCHECKED not in cell.metadata.get("tags", [])]
    assert len(compared) >= 2
    for cell in compared:
        assert not any("image/png" in o.get("data", {}) or o.get("name") == "stderr" for o in cell.outputs), cell.source


def test_it_is_small_and_knows_nothing_of_the_machine_it_ran_on(notebook):
    text = nbformat.writes(notebook)
    assert len(text) < 1_500_000
    assert not re.search(r"/(work|home|root|Users|tmp)/", re.sub(r'"image/png": "[^"]*"', "", text))
