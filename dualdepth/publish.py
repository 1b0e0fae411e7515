"""Keep what a run made: its tables and figures as a committed snapshot, its executed tiny notebooks as the committed ones."""

import argparse
import shutil
import sys

import nbformat

from dualdepth.atomic import atomic_path
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.results import Run


def publish_results(profile: str) -> int:
    """Copy `results/<profile>/{tables,figures}` to `results/published/<profile>/`; pictures of real frames stay out.

    Raises:
        InputError: the profile has no results yet.
    """
    run = Run(profile)
    run.require(run.results / "tables", "05_table_main")
    target = run.root / "results" / "published" / run.profile.name
    shutil.rmtree(target, ignore_errors=True)
    # frames of real data sets are not ours to publish
    folders = ("tables", "figures") if run.profile.world else ("tables",)
    for folder in folders:
        if (run.results / folder).is_dir():
            shutil.copytree(run.results / folder, target / folder)
    files = sum(1 for path in target.rglob("*") if path.is_file())
    print(f"{target.relative_to(run.root)}: {files} files")
    return files


def publish_notebooks() -> int:
    """Store the executed copies of `results/tiny/notebooks` as `notebooks/`, without papermill's traces."""
    run = Run("tiny")
    stored = 0
    for source in sorted((run.root / "notebooks").glob("*.ipynb")):
        copies = sorted((run.results / "notebooks").glob(f"{source.stem}*.ipynb"))
        if not copies:
            raise InputError(f"results/tiny/notebooks holds no {source.name}: run `make reproduce` first")
        notebook = nbformat.read(copies[0], as_version=4)
        notebook.metadata.pop("papermill", None)
        notebook.metadata.pop("widgets", None)
        notebook.cells = [cell for cell in notebook.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
        for number, cell in enumerate(notebook.cells):
            for key in ("papermill", "execution"):
                cell.metadata.pop(key, None)
            cell["id"] = f"{source.stem[:2]}-{number:02d}"  # stable, so that a rerun changes outputs only
        count = 0
        for cell in notebook.cells:
            if cell.cell_type == "code":
                count += 1
                cell.execution_count = count
                for output in cell.outputs:
                    if "execution_count" in output:
                        output.execution_count = count
        with atomic_path(source) as partial:
            nbformat.write(notebook, partial)
        stored += 1
    print(f"notebooks: {stored} stored")
    return stored


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Keep what a run made.")
    parser.add_argument("what", choices=("results", "notebooks"))
    parser.add_argument("--profile", default="tiny")
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        publish_notebooks() if arguments.what == "notebooks" else publish_results(arguments.profile)
    return 0


if __name__ == "__main__":
    sys.exit(main())
