"""Running a notebook by papermill: checked parameters, progress in the terminal, an executed copy that is whole or absent."""

import logging
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
        known = ", ".join(sorted(p.stem for p in source.parent.glob("*.ipynb")))
        raise InputError(f"notebook {name!r} not found; there are {known}")
    known = papermill.inspect_notebook(str(source))
    unknown = sorted(set(parameters) - set(known))
    if unknown:
        raise InputError(f"{source.name}: unknown parameter {', '.join(unknown)}; it has {', '.join(known)}")
    title = f"{name} ({', '.join(f'{k} {v}' for k, v in parameters.items() if v not in ('', None))})"
    print(f"▶ {title}", file=sys.stderr, flush=True)
    began = time.perf_counter()
    _show_streams()
    # of a progress bar, the copy keeps the last state alone; the kernel's own log says nothing about the notebook
    log_level = ["--IPKernelApp.log_level=50"]
    settings = {"progress_bar": False, "log_output": True, "coalesce_streams": True, "extra_arguments": log_level}
    with atomic_path(out) as partial:
        try:
            papermill.execute_notebook(str(source), str(partial), parameters, cwd=str(root), **settings)
        except PapermillExecutionError as error:
            shutil.copyfile(partial, failed)
            if error.ename in ("InputError", "PermissionError", "SystemExit"):  # the last: a training that was told to stop
                raise InputError(error.evalue) from None
            raise RuntimeError(f"{source.name} failed in cell {error.cell_index}: {error.ename}: {error.evalue}; see {failed}") from None
        except DeadKernelError:
            raise InputError(f"{source.name}: its kernel died, such as for want of memory; run the same command to go on") from None
    failed.unlink(missing_ok=True)
    print(f"✓ {title}: {time.perf_counter() - began:.0f} s", file=sys.stderr, flush=True)
    return out


def _show_streams() -> None:
    """Show what a notebook's cells print, progress bars included, on stderr as it comes."""
    handler = logging.StreamHandler(sys.stderr)
    handler.terminator = ""
    handler.addFilter(lambda record: not record.getMessage().startswith(NOT_SHOWN))
    logger = logging.getLogger("papermill")
    logger.handlers, logger.propagate = [handler], False
    logger.setLevel(logging.INFO)
