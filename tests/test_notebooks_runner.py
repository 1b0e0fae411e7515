"""Running a notebook: checked parameters, an executed copy that is whole or absent."""

import sys

import nbformat
import pytest

from dualdepth.cli import main
from dualdepth.errors import InputError
from dualdepth.notebooks import run_notebook


def write_notebook(path, *cells):
    """A notebook whose first cell holds the parameters `profile` and `seed`."""
    parameters = nbformat.v4.new_code_cell('profile = "tiny"\nseed = 0', metadata={"tags": ["parameters"]})
    notebook = nbformat.v4.new_notebook(cells=[parameters, *(nbformat.v4.new_code_cell(c) for c in cells)])
    notebook.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    nbformat.write(notebook, path)


@pytest.fixture
def project(checkout, monkeypatch):
    """A root with one notebook and without anything else."""
    write_notebook(checkout / "notebooks/00_sum.ipynb", "print(profile, seed + 1)")
    monkeypatch.chdir(checkout)
    return checkout


@pytest.mark.slow
def test_an_executed_copy_shows_what_its_parameters_gave_in_this_python_whatever_kernel_jupyter_knows(project, capsys, monkeypatch):
    (project / "kernels/python3").mkdir(parents=True)
    (project / "kernels/python3/kernel.json").write_text('{"argv": ["/nowhere"], "display_name": "Python 3", "language": "python"}')
    monkeypatch.setenv("JUPYTER_PATH", str(project))
    bar = 'import sys\n_ = sys.stderr.write("0%\\r50%\\r100%\\n")'
    write_notebook(project / "notebooks/00_sum.ipynb", "import os, sys\nprint(profile, seed + 1, os.getcwd(), sys.executable)", bar)
    source = (project / "notebooks/00_sum.ipynb").read_bytes()
    out = run_notebook("00_sum", "results/00_sum.ipynb", {"profile": "own", "seed": 41})
    executed = nbformat.read(out, as_version=4)
    texts = [o.text for cell in executed.cells for o in cell.outputs]
    assert texts == [f"own 42 {project} {sys.executable}\n", "100%\n"]  # run at the root; of a progress bar only its end is kept
    assert all(cell.execution_count for cell in executed.cells)
    assert (project / "notebooks/00_sum.ipynb").read_bytes() == source
    assert [p.name for p in (project / "results").iterdir()] == ["00_sum.ipynb"]
    assert "own 42" in capsys.readouterr().err  # shown while it runs


@pytest.mark.slow
def test_a_failing_notebook_leaves_a_copy_to_look_at_and_the_result_before_it_until_one_succeeds(project):
    (project / "results").mkdir()
    out, failed = project / "results/00_sum.ipynb", project / "results/00_sum.failed.ipynb"
    out.write_text("of yesterday")
    write_notebook(project / "notebooks/00_sum.ipynb", "print('before')", "1 / 0", "print('after')")
    with pytest.raises(RuntimeError, match=r"00_sum\.ipynb failed in cell \d: ZeroDivisionError: .*00_sum\.failed\.ipynb"):
        run_notebook("00_sum", out, {})
    assert out.read_text() == "of yesterday" and set(out.parent.iterdir()) == {out, failed}
    assert "before" in failed.read_text() and "ZeroDivisionError" in failed.read_text()
    write_notebook(project / "notebooks/00_sum.ipynb", "print(seed)")
    run_notebook("00_sum", out, {})
    assert set(out.parent.iterdir()) == {out}


@pytest.mark.slow
def test_a_users_mistake_inside_a_notebook_is_one_line_outside(project, capsys):
    mistake = 'from dualdepth.errors import InputError\nraise InputError("KITTI_ROOT nowhere is not a folder")'
    write_notebook(project / "notebooks/00_sum.ipynb", mistake)
    with pytest.raises(SystemExit) as stopped:
        main(["notebook", "00_sum", "--out", "results/00_sum.ipynb"])
    assert stopped.value.code == 2
    assert capsys.readouterr().err.strip().splitlines()[-1] == "error: KITTI_ROOT nowhere is not a folder"
    assert not (project / "results/00_sum.ipynb").exists()


@pytest.mark.slow
def test_a_kernel_that_dies_is_one_line(project):
    write_notebook(project / "notebooks/00_sum.ipynb", "import os; os.kill(os.getpid(), 9)")
    with pytest.raises(InputError, match=r"^00_sum\.ipynb: its kernel died"):
        run_notebook("00_sum", "results/00_sum.ipynb", {})
    assert not list((project / "results").glob("*"))


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["00_sum", "--set", "sede=1"], "00_sum.ipynb: unknown parameter sede; it has profile, seed"),
        (["00_sum", "--set", "seed"], "parameter 'seed' is not KEY=VALUE"),
        (["07_none"], "notebook '07_none' not found; there are 00_sum"),
    ],
)
def test_unknown_names_are_one_line_that_names_those_there_are(project, refused, words, said):
    assert said in refused(main, ["notebook", *words, "--out", "results/00_sum.ipynb"])
    assert not (project / "results").exists()
