"""Notebooks: the chain of all by Snakemake, one by papermill."""

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
from dualdepth.files import atomic_path, check_writable, locked, remove_leftovers, write_text
from dualdepth.profile import PROFILES, profile_path
from dualdepth.run import Run, check_roots, parse_seeds, project_root

DRY = re.compile(r"--dry-?run|-[a-z]*n[a-z]*")  # Snakemake's options for only saying what it would run, such as `-np`.


def run_chain(profile: str, roots: Mapping[str, str], seeds: str, allow_leak: bool, cores: str, options: Sequence[str]) -> NoReturn:
    """Become Snakemake, which runs a profile's notebooks under a lock, so that two runs cannot mix; a dry run needs none. An `InputError`
    says that the profile, seeds or a root is wrong, nothing can be written, or another process or profile of this name has the folders.

    `roots` are files and folders that a user gives, by the names of `run.ROOTS`; `seeds` such as `0,1,2`, empty for the profile's; `cores`
    and `options` are Snakemake's.
    """
    run, dry = Run(profile), any(map(DRY.fullmatch, options))
    path, noted = profile_path(profile), run.work / "profile.txt"
    file = os.path.relpath(run.root / "dualdepth/profiles" / path.name if path.parent == PROFILES else path, run.root)
    other = noted.read_text(encoding="utf-8") if noted.is_file() else file
    if other != file and (there := run.root / other).is_file() and not there.samefile(path):
        raise InputError(f"{profile}: work/{run.profile.name} and results/{run.profile.name} are of {other}; give this file another name")
    check_roots(roots)
    config = {
        "profile": str(Path(profile).resolve()) if Path(profile).is_file() else profile,
        "seeds": ",".join(map(str, parse_seeds(seeds or ",".join(map(str, run.profile.seeds))))),
        **{name: str(Path(value).resolve()) if value else "" for name, value in roots.items()},
        "allow_leak": int(allow_leak),
    }
    command = [sys.executable, "-m", "dualdepth.notebooks", "snakemake", "--quiet", *(["host", "progress"] if dry else ["all"])]
    if shutil.which("nvidia-smi"):
        command += ["--resources", "gpu=1"]  # one training at a time has the GPU to itself
    command += ["--cores", cores, "--nolock", "--rerun-incomplete", *options]
    command += ["--config", f"given={json.dumps(config, ensure_ascii=False)}"]  # Snakemake reads YAML, and strips outer quotes
    if not os.access(os.path.expanduser("~"), os.W_OK | os.X_OK):  # as under `docker run --user`
        for name in ("XDG_CACHE_HOME", "MPLCONFIGDIR", "IPYTHONDIR", "JUPYTER_RUNTIME_DIR"):
            os.environ.setdefault(name, str(run.root / "work/home" / name.lower()))
    check_writable(run.root / ".snakemake")  # of which Snakemake, being quiet, would not say a word
    with nullcontext() if dry else locked(run.work / "lock", inherited=True):
        for folder, below in () if dry else ((run.work, False), (run.results, True), (run.prepared, True)):  # trainings clear their own
            remove_leftovers(folder, below=below)
        write_text(noted, file) if not dry else None
        print(f"profile {run.profile.name}: {run.profile.about}; results in {run.results.relative_to(run.root)}", flush=True)
        os.chdir(run.root)
        os.execv(sys.executable, command)


def parse_parameters(pairs: Sequence[str]) -> dict[str, int | str]:
    """Parameters of `KEY=VALUE` words, else an `InputError`: whole numbers as such, all else as text, which nothing evaluates."""
    if wrong := [pair for pair in pairs if "=" not in pair]:
        raise InputError(f"parameter {wrong[0]!r} is not KEY=VALUE")
    words = dict(pair.split("=", 1) for pair in pairs)
    return {key: int(value) if re.fullmatch("-?[0-9]{1,18}", value) else value for key, value in words.items()}


def run_notebook(name: str, out: str | Path, parameters: dict[str, Any]) -> Path:
    """Execute `notebooks/<name>.ipynb` and write the executed copy to `out`.

    A failing notebook leaves its copy, up to the failing cell, as `<out>.failed.ipynb`. An `InputError` says that there is no such
    notebook or parameter, what an `InputError` inside it said, or that its kernel died; any other error inside it is a `RuntimeError`.
    """
    import papermill
    from ipykernel.kernelspec import get_kernel_dict
    from jupyter_client import AsyncKernelManager
    from jupyter_client.kernelspec import KernelSpec
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
    os.environ.pop("PYTHONSAFEPATH", None)  # with it ipykernel drops the first folder of PYTHONPATH, which is this checkout
    # what cells print is shown as it comes, progress bars included; the copy keeps the last state of a bar alone
    settings = {"progress_bar": False, "stdout_file": sys.stderr, "stderr_file": sys.stderr, "coalesce_streams": True}
    settings["kernel_manager_class"] = type("ThisPython", (AsyncKernelManager,), {"kernel_spec": KernelSpec(**get_kernel_dict())})
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


if __name__ == "__main__":  # what `run_chain` becomes: Snakemake, but what is wrong with the chain is one line, even under `--quiet all`
    from snakemake import api, cli

    def _tell(error: Exception, *_: Any) -> None:
        if "At least one job" not in str(error):  # of which the job has told
            print(f"error: Snakefile: {type(error).__name__}: {' '.join(str(error).split())[:500]}", file=sys.stderr)

    api.print_exception = cli.print_exception = _tell
    sys.argv.pop(0)
    with exit_on_input_error():
        cli.main()
