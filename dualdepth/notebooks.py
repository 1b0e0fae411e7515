"""Notebooks: the chain of all by Snakemake, one by papermill; stored without what differs from run to run, published with results."""

import argparse
import ast
import base64
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Mapping, Sequence
from contextlib import nullcontext
from pathlib import Path
from typing import Any, NoReturn

from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import atomic_path, check_writable, locked, remove_leftovers
from dualdepth.run import Run, check_roots, parse_seeds, project_root

DRY = re.compile(r"--dry-?run|-[a-z]*n[a-z]*")
"""Snakemake's options for only saying what it would run, such as `-np`."""

PICTURE_WIDTH = 900
"""Pixels that a picture in a published notebook has at most."""


def run_chain(profile: str, roots: Mapping[str, str], seeds: str, allow_leak: bool, cores: str, options: Sequence[str]) -> NoReturn:
    """Become Snakemake, which runs a profile's notebooks under a lock, so that two runs cannot mix; a dry run needs none.

    Args:
        profile: its name or file.
        roots: folders and files that a user gives, by the names of `run.ROOTS`.
        seeds: such as `0,1,2`; empty for the profile's.
        allow_leak: score even drives that were trained on.
        cores, options: for Snakemake.

    Raises:
        InputError: the profile, seeds or a root is wrong, nothing can be written, or another process works on the profile.
    """
    run, dry = Run(profile), any(map(DRY.fullmatch, options))
    check_roots(roots)
    config = {
        "profile": str(Path(profile).resolve()) if Path(profile).is_file() else profile,
        "seeds": ",".join(map(str, parse_seeds(seeds) or run.profile.seeds)),
        **{name: str(Path(value).resolve()) if value else "" for name, value in roots.items()},
        "allow_leak": int(allow_leak),
    }
    command = [sys.executable, "-m", "snakemake", "--cores", cores, "--nolock", "--rerun-incomplete"]
    command += ["--quiet", *(["host", "progress"] if dry else ["all"])]
    if shutil.which("nvidia-smi"):
        command += ["--resources", "gpu=1"]  # one training at a time has the GPU to itself
    command += [*options, "--config", *(f"{k}={v}" for k, v in config.items())]
    check_writable(run.root / ".snakemake")  # of which Snakemake, being quiet, would not say a word
    with nullcontext() if dry else locked(run.work / "lock", inherited=True):
        for folder in () if dry else (run.results, run.prepared):  # a training looks after its own
            remove_leftovers(folder)
        print(f"profile {run.profile.name}: {run.profile.about}; results in {run.results.relative_to(run.root)}", flush=True)
        os.chdir(run.root)
        os.execv(sys.executable, command)


def parse_parameters(pairs: Sequence[str]) -> dict[str, int | str]:
    """Parameters of `KEY=VALUE` words: whole numbers as such, all else as text, which nothing evaluates.

    Raises:
        InputError: a word without `=`.
    """
    parameters: dict[str, int | str] = {}
    for pair in pairs:
        key, equals, value = pair.partition("=")
        if not equals:
            raise InputError(f"parameter {pair!r} is not KEY=VALUE")
        parameters[key] = int(value) if re.fullmatch("-?[0-9]{1,18}", value) else value
    return parameters


def run_notebook(name: str, out: str | Path, parameters: dict[str, Any]) -> Path:
    """Execute `notebooks/<name>.ipynb` and write the executed copy to `out`.

    A failing notebook leaves its copy, up to the failing cell, as `<out>.failed.ipynb`.

    Raises:
        InputError: no such notebook, a parameter that it does not have, or an `InputError` inside it; or its kernel died.
        RuntimeError: any other error inside it.
    """
    import papermill
    from nbclient.exceptions import DeadKernelError
    from papermill.exceptions import PapermillExecutionError

    root, out = project_root(), Path(out)
    source, failed = root / "notebooks" / f"{name}.ipynb", out.with_suffix(".failed.ipynb")
    if not source.is_file():
        raise InputError(f"notebook {name!r} not found; there are {', '.join(sorted(p.stem for p in source.parent.glob('*.ipynb')))}")
    known = papermill.inspect_notebook(str(source))
    if unknown := sorted(set(parameters) - set(known)):
        raise InputError(f"{source.name}: unknown parameter {', '.join(unknown)}; it has {', '.join(known)}")
    title = f"{name} ({', '.join(f'{k} {v}' for k, v in parameters.items() if v not in ('', None))})"
    print(f"▶ {title}", file=sys.stderr, flush=True)
    began = time.perf_counter()
    # what cells print is shown as it comes, progress bars included; the copy keeps the last state of a bar alone
    settings = {"progress_bar": False, "stdout_file": sys.stderr, "stderr_file": sys.stderr, "coalesce_streams": True}
    settings["extra_arguments"] = ["--IPKernelApp.log_level=50"]  # the kernel's own log says nothing about the notebook
    with atomic_path(out) as partial:
        try:
            papermill.execute_notebook(str(source), str(partial), parameters, cwd=str(root), **settings)
        except PapermillExecutionError as error:
            os.replace(partial, failed)
            if error.ename in ("InputError", "PermissionError", "SystemExit"):  # the last: a training that was told to stop
                raise InputError(error.evalue) from None
            raise RuntimeError(f"{source.name} failed in cell {error.cell_index}: {error.ename}: {error.evalue}; see {failed}") from None
        except DeadKernelError:
            raise InputError(f"{source.name}: its kernel died, such as for want of memory; run the same command to go on") from None
    failed.unlink(missing_ok=True)
    print(f"✓ {title}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return out


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
        for path in sorted((run.results / "notebooks").glob("*.ipynb")):
            _store(path, target / "notebooks" / path.name, small=True)
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
        _store(_default_copy(source, run.results / "notebooks"), source)
    print(f"notebooks: {len(sources)} stored")
    return len(sources)


def _default_copy(source: Path, folder: Path) -> Path:
    """The executed copy of a notebook that had the parameters which are written in it."""
    import papermill

    defaults = {k: str(ast.literal_eval(v["default"])) for k, v in papermill.inspect_notebook(str(source)).items()}
    for copy in sorted(folder.glob(f"{source.stem}*.ipynb")):
        given = json.loads(copy.read_text(encoding="utf-8"))["metadata"]["papermill"]["parameters"]
        if all(str(given[k]) == v for k, v in defaults.items() if k in given):
            return copy
    raise InputError(f"{folder}: holds no copy of {source.name} with its own parameters; run `make reproduce` first")


def _store(executed: Path, target: Path, small: bool = False) -> None:
    """Write an executed notebook without papermill's traces, with cells, their ids and the names of styled tables numbered anew."""
    import nbformat

    notebook = nbformat.read(executed, as_version=4)
    notebook.cells = [cell for cell in notebook.cells if "injected-parameters" not in cell.metadata.get("tags", [])]
    for part in (notebook, *notebook.cells):
        for key in ("papermill", "widgets", "execution"):
            part.metadata.pop(key, None)
    for number, cell in enumerate(notebook.cells):
        cell.id = f"{executed.stem[:2]}-{number:02d}"
    for count, cell in enumerate((cell for cell in notebook.cells if cell.cell_type == "code"), 1):
        cell.execution_count = count
        for place, output in enumerate(cell.outputs):
            data = output.get("data", {})
            if "execution_count" in output:
                output.execution_count = count
            if html := data.get("text/html"):  # pandas draws a name for each styled table
                data["text/html"] = re.sub(r"\bT_[0-9a-f]{5}(?=\b|_)", f"T_{count}_{place}", html)
            if small and "image/png" in data:
                data["image/jpeg"] = _small_jpeg(data.pop("image/png"))
    with atomic_path(target) as partial:
        nbformat.write(notebook, partial)


def _small_jpeg(png: str) -> str:
    """A picture, both in base64, as JPEG of at most `PICTURE_WIDTH` pixels: a tenth of the bytes."""
    import cv2
    import numpy as np

    picture = cv2.imdecode(np.frombuffer(base64.b64decode(png), np.uint8), cv2.IMREAD_COLOR)
    scale = min(1.0, PICTURE_WIDTH / picture.shape[1])
    picture = cv2.resize(picture, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return base64.b64encode(cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, 85])[1]).decode()


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
