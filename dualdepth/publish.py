"""Keep what a run made: tables, figures and executed notebooks as a committed snapshot, those of tiny as the stored notebooks."""

import argparse
import ast
import base64
import json
import re
import shutil
import sys
from pathlib import Path

import cv2
import nbformat
import numpy as np
import papermill

from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import atomic_path
from dualdepth.run import Run

PICTURE_WIDTH = 900
"""Pixels that a picture in a kept notebook has at most."""


def publish_results(profile: str) -> int:
    """Copy `results/<profile>/{tables,figures}` to `results/published/<profile>/`; pictures of real frames stay out.

    Raises:
        InputError: the profile has no results yet, or some were made by code that was not committed.
    """
    run = Run(profile)
    run.require(run.results / "tables", "05_table_main")
    dirty = [p.name for p in sorted(run.results.glob("*/*.json")) if json.loads(p.read_text(encoding="utf-8"))["dirty"]]
    if dirty:
        raise InputError(f"{run.results}: {', '.join(dirty)} were made by code that was not committed; commit it and run again")
    target = run.root / "results" / "published" / run.profile.name
    shutil.rmtree(target, ignore_errors=True)
    for folder in ("tables", "figures") if run.profile.world else ("tables",):  # frames of real data sets are not ours to publish
        if (run.results / folder).is_dir():
            shutil.copytree(run.results / folder, target / folder)
    if run.profile.world and run.profile.name != "tiny":  # whose executed notebooks are the stored ones
        (target / "notebooks").mkdir()
        for path in sorted((run.results / "notebooks").glob("*.ipynb")):
            notebook = nbformat.read(path, as_version=4)
            _clean(notebook, path.stem[:2])
            _shrink_pictures(notebook)
            nbformat.write(notebook, target / "notebooks" / path.name)
    files = sum(path.is_file() for path in target.rglob("*"))
    print(f"{target.relative_to(run.root)}: {files} files")
    return files


def publish_notebooks() -> int:
    """Store the executed copies of `results/tiny/notebooks` as `notebooks/`, without what differs from run to run.

    Raises:
        InputError: no copy of a notebook has the parameters that are written in it.
    """
    run = Run("tiny")
    sources = sorted((run.root / "notebooks").glob("*.ipynb"))
    for source in sources:
        notebook = _default_copy(source, run.results / "notebooks")
        _clean(notebook, source.stem[:2])
        with atomic_path(source) as partial:
            nbformat.write(notebook, partial)
    print(f"notebooks: {len(sources)} stored")
    return len(sources)


def _default_copy(source: Path, folder: Path) -> nbformat.NotebookNode:
    defaults = {k: ast.literal_eval(v["default"]) for k, v in papermill.inspect_notebook(str(source)).items()}
    for copy in sorted(folder.glob(f"{source.stem}*.ipynb")):
        notebook = nbformat.read(copy, as_version=4)
        given = notebook.metadata.papermill.parameters
        if all(str(given[k]) == str(v) for k, v in defaults.items() if k in given):
            return notebook
    raise InputError(f"{folder}: holds no copy of {source.name} with its own parameters; run `make reproduce` first")


def _shrink_pictures(notebook: nbformat.NotebookNode) -> None:
    """Store the notebook's pictures as JPEG of at most `PICTURE_WIDTH` pixels, a tenth of their bytes."""
    for output in (output for cell in notebook.cells if cell.cell_type == "code" for output in cell.outputs):
        if png := output.get("data", {}).pop("image/png", None):
            picture = cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)
            scale = min(1.0, PICTURE_WIDTH / picture.shape[1])
            picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
            output.data["image/jpeg"] = base64.b64encode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]).decode()


def _clean(notebook: nbformat.NotebookNode, page: str) -> None:
    """Remove papermill's traces; number cells, their ids and the names of styled tables anew."""
    notebook.cells = [cell for cell in notebook.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    for part in (notebook, *notebook.cells):
        for key in ("papermill", "widgets", "execution"):
            part.metadata.pop(key, None)
    for number, cell in enumerate(notebook.cells):
        cell.id = f"{page}-{number:02d}"
    for count, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), 1):
        cell.execution_count = count
        for place, output in enumerate(cell.outputs):
            if "execution_count" in output:
                output.execution_count = count
            if html := output.get("data", {}).get("text/html"):  # pandas draws a name for each styled table
                output.data["text/html"] = re.sub(r"\bT_[0-9a-f]{5}(?=\b|_)", f"T_{count}_{place}", html)


def main(argv: list[str] | None = None) -> int:
    """Run the command line."""
    parser = argparse.ArgumentParser(description="Keep what a run made.")
    parser.add_argument("what", choices=("results", "notebooks"))
    parser.add_argument("--profile", default="miniature")
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        publish_notebooks() if arguments.what == "notebooks" else publish_results(arguments.profile)
    return 0


if __name__ == "__main__":
    sys.exit(main())
