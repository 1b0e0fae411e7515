"""Where the chain of a profile stands: which steps are done, which are stale and why, which are missing, which are running."""

import contextlib
import shutil
import tempfile
from ast import literal_eval
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from dualdepth.errors import InputError
from dualdepth.ingredients import changes
from dualdepth.lock import holder
from dualdepth.results import Run

STATES = ("done", "stale", "missing", "running")


class Step(NamedTuple):
    """One step of the chain."""

    name: str
    """As its notebook in `results/<profile>/notebooks`."""
    state: str
    """One of `STATES`."""
    why: str
    """What made it stale, what is missing, or how far it is; of a step that is done nothing."""


def chain_steps(run: Run, config: dict[str, Any]) -> list[Step]:
    """The steps in their order, as Snakemake would find them now; nothing is written.

    Args:
        run: of the profile.
        config: what `dualdepth reproduce` hands to Snakemake.

    Raises:
        InputError: Snakemake cannot read the chain.
    """
    live = holder(run.work / "lock") is not None
    with _workflow(run.root, config) as flow:
        jobs = [job for job in flow.dag.jobs if job.output]
        makers = {str(file): _name(job) for job in jobs for file in job.output}
        return sorted(_step(run, flow, job, makers, live) for job in jobs)


@contextlib.contextmanager
def _workflow(root: Path, config: dict[str, Any]) -> Iterator[Any]:
    """Snakemake's workflow with its graph of jobs, as of a dry run.

    Snakemake writes into its folder even when it is only asked, so it is asked in a folder of links to the checkout. The reasons are
    told in its log alone; here they are read where it keeps them.
    """
    from snakemake.api import SnakemakeApi
    from snakemake.exceptions import WorkflowError
    from snakemake.settings.types import ConfigSettings, DAGSettings, OutputSettings, Quietness, ResourceSettings

    with tempfile.TemporaryDirectory(prefix="dualdepth-status-") as name:
        folder = Path(name)
        for entry in root.iterdir():
            if entry.name != ".snakemake":
                (folder / entry.name).symlink_to(entry)
        for part in ("metadata", "incomplete"):
            _copy(root / ".snakemake" / part, folder / ".snakemake" / part)
        with SnakemakeApi(OutputSettings(dryrun=True, quiet={Quietness.ALL}, log_level_override=50)) as api:
            try:
                flow = api.workflow(ResourceSettings(cores=1), ConfigSettings(config=config), snakefile=Path("Snakefile"), workdir=folder)
                workflow = flow._workflow
                workflow.dag_settings = DAGSettings(force_incomplete=True)
                workflow._prepare_dag(forceall=False, ignore_incomplete=False, lock_warn_only=False, nolock=True)
                workflow._build_dag()
            except WorkflowError as error:
                raise InputError(f"{root / 'Snakefile'}: Snakemake cannot read it ({error})") from None
            yield workflow


def _copy(source: Path, target: Path) -> None:
    """Copy a folder in which a live run may be writing; what vanishes meanwhile is left out."""
    with contextlib.suppress(shutil.Error, FileNotFoundError):
        shutil.copytree(source, target)


def _step(run: Run, flow: Any, job: Any, makers: dict[str, str], live: bool) -> Step:
    from dualdepth.checkpoints import checkpoint_paths

    name, reason = _name(job), flow.dag.reason(job)
    begun = bool(flow.persistence._filter_incomplete_keys(map(str, job.output)))
    training = [int(job.wildcards.seed) if key == "seed" else value for key, value in job.wildcards.items()]
    by_hand = holder(run.training(*training) / "lock") if training else None
    if by_hand or (live and begun):
        return Step(name, "running", ", ".join(filter(None, [_progress(run, *training) if training else "", by_hand])))
    if not flow.dag.needrun(job):
        return Step(name, "done", "")
    gone = [str(file) for file in job.output if not (run.root / file).exists()]
    if len(gone) == len(job.output):
        stopped = training and checkpoint_paths(run.training(*training))
        return Step(name, "missing", f"stopped at {_progress(run, *training)}" if stopped else "its last run was broken off" * begun)
    if gone:
        return Step(name, "missing", f"{', '.join(gone)} not there")
    return Step(name, "stale", "; ".join(_words(flow, job, reason, makers)))


def _name(job: Any) -> str:
    """Of the job's notebook, its first output."""
    return Path(str(job.output[0])).stem


def _words(flow: Any, job: Any, reason: Any, makers: dict[str, str]) -> list[str]:
    """Why Snakemake would run a job whose outputs are there."""
    words = ["its last run was broken off"] if reason.forced else []
    if reason.params_changed:
        words += _changed_ingredients(flow, job)
    if reason.code_changed:
        words.append("its command in the Snakefile changed")
    if reason.input_changed:
        before = {path for file in job.output for path in flow.persistence.input(file) or ()}
        words += [f"takes {path} now" for path in sorted(set(map(str, job.input)) - before)]
        words += [f"takes {path} no more" for path in sorted(before - set(map(str, job.input)))]
    words += [f"{path} changed" for path in sorted(map(str, reason.updated_input - reason.updated_input_run))]
    steps = sorted({makers.get(str(path), str(path)) for path in reason.updated_input_run})
    return words + ([f"waits for {', '.join(steps)}"] if steps else [])


def _changed_ingredients(flow: Any, job: Any) -> list[str]:
    """What the step was made from, as Snakemake noted it then, compared with what it would be made from now."""
    now = job.params.made_from
    for file in job.output:
        for recorded in flow.persistence.params(file) or ():
            with contextlib.suppress(ValueError, SyntaxError):
                before = literal_eval(recorded)
                if isinstance(before, dict) and before != now:
                    return changes(before, now)
    return ["what it is made from changed"]


def _progress(run: Run, variant: str, seed: int) -> str:
    """How far a training is, by its log."""
    from dualdepth.training import total_steps
    from dualdepth.training_log import read_log

    log, index = run.training(variant, seed) / "log.csv", run.index(variant)
    if not (log.exists() and index.exists()):
        return "its start"
    triplets = len(index.read_text(encoding="utf-8").splitlines()) - 1
    stage = getattr(run.profile.of_variant(variant).training, run.profile.variant(variant).stage)
    return f"step {read_log(log)['step'].iloc[-1]} of {total_steps(stage, triplets)}"
