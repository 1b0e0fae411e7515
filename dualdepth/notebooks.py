"""Running a notebook by papermill: checked parameters, progress in the terminal, an executed copy that is whole or absent."""

import logging
import re
import shutil
import sys
import time
from pathlib import Path
from typing import Any

from dualdepth.errors import InputError
from dualdepth.files import atomic_path
from dualdepth.run import project_root

NOT_SHOWN = ("Executing", "Ending", "Input", "Output", "Working directory", "<", "\n")
"""What papermill says of its own, and the text form of pictures and tables, which nobody reads in a terminal."""
KERNEL_LOG = "--IPKernelApp.log_level=50"
"""The kernel's own log says nothing about the notebook."""


def run_notebook(name: str, out: str | Path, parameters: dict[str, Any]) -> Path:
    """Execute `notebooks/<name>.ipynb` and write the executed copy to `out`.

    A failing notebook leaves its copy, up to the failing cell, as `<out>.failed.ipynb`.

    Raises:
        InputError: no such notebook, a parameter that it does not have, or an `InputError` inside it; or its kernel died.
        RuntimeError: any other error inside it.
    """
    import nbformat
    import papermill
    from nbclient.exceptions import DeadKernelError
    from papermill.exceptions import PapermillExecutionError

    root, out = project_root(), Path(out)
    source = root / "notebooks" / f"{name}.ipynb"
    if not source.is_file():
        known = ", ".join(sorted(p.stem for p in source.parent.glob("*.ipynb")))
        raise InputError(f"notebook {name!r} not found; there are {known}")
    known = papermill.inspect_notebook(str(source))
    unknown = sorted(set(parameters) - set(known))
    if unknown:
        raise InputError(f"{source.name}: unknown parameter {', '.join(unknown)}; it has {', '.join(known)}")
    said = ", ".join(f"{k} {v}" for k, v in parameters.items() if v not in ("", None))
    print(f"▶ {name} ({said})", file=sys.stderr, flush=True)
    began = time.perf_counter()
    failed = out.with_suffix(".failed.ipynb")
    with atomic_path(out) as partial, _StreamsShown():
        try:
            papermill.execute_notebook(
                str(source),
                str(partial),
                parameters,
                cwd=str(root),
                progress_bar=False,
                log_output=True,
                extra_arguments=[KERNEL_LOG],
            )
        except PapermillExecutionError as error:
            shutil.copyfile(partial, failed)
            if error.ename in ("InputError", "PermissionError"):
                raise InputError(error.evalue) from None
            raise RuntimeError(f"{source.name} failed in cell {error.cell_index}: {error.ename}: {error.evalue}; see {failed}") from None
        except DeadKernelError:
            raise InputError(f"{source.name}: its kernel died, such as for want of memory; run the same command to go on") from None
        notebook = nbformat.read(partial, as_version=4)
        _collapse_progress(notebook)
        nbformat.write(notebook, partial)
    failed.unlink(missing_ok=True)
    print(f"✓ {name} ({said}): {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return out


class _StreamsShown:
    """Shows what the notebook's cells print, progress bars included, on stderr as it comes."""

    def __enter__(self) -> None:
        self.logger = logging.getLogger("papermill")
        self.before = self.logger.level, self.logger.propagate
        self.handler = logging.StreamHandler(sys.stderr)
        self.handler.terminator = ""
        self.handler.addFilter(lambda record: record.name == "papermill" and not record.getMessage().startswith(NOT_SHOWN))
        self.logger.addHandler(self.handler)
        self.logger.setLevel(logging.INFO)
        self.logger.propagate = False

    def __exit__(self, *_: object) -> None:
        self.logger.removeHandler(self.handler)
        self.logger.setLevel(self.before[0])
        self.logger.propagate = self.before[1]


def _collapse_progress(notebook: Any) -> None:
    """Join the pieces of each stream, and keep only the last state of each progress bar."""
    for cell in notebook.cells:
        joined: list[Any] = []
        for output in cell.get("outputs", []):
            last = joined[-1] if joined else None
            if last and output.output_type == last.output_type == "stream" and output.name == last.name:
                last.text += output.text
            else:
                joined.append(output)
        for output in joined:
            if output.output_type == "stream":
                output.text = re.sub(r"[^\n]*\r(?!\n)", "", output.text)
        if "outputs" in cell:
            cell.outputs = joined
