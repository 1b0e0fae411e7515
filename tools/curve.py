"""Error against time while trainings run, scored on a run's frames from their checkpoints; the trainings are not touched.

python -m tools.curve lr_plain lr dual --profile sample

Run it beside the chain: a finished training deletes its checkpoints. The curve is for looking: what counts is its last point, the weights.
"""

import argparse
import time
from pathlib import Path

import pandas as pd
import torch
from matplotlib.figure import Figure

from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.evaluation.depth import evaluate, summary
from dualdepth.model import DepthModel, load
from dualdepth.run import Run
from dualdepth.tables.scores import Scored
from dualdepth.training.checkpoints import checkpoint_paths, load_checkpoint
from dualdepth.training.variants import make_stage, start_weights
from dualdepth.training.weights import load_card

SEED = 0


def score(run: Run, name: str, path: Path) -> dict[str, float]:
    """Errors of a training's weights, or of those that it would have kept if it had ended at a checkpoint, and the minutes
    until then, which are right unless it was resumed."""
    scored = Scored(run)
    if path.suffix == ".pt":
        state = load_checkpoint(path)
        stage = make_stage(run.profile, name, start_weights(run, name, SEED))
        kept = state.get("average", state["model"])
        stage.load_state_dict({key.removeprefix("module."): value for key, value in kept.items() if key != "n_averaged"})
        card = run.profile.architecture(name).model_dump() | {"hr_size": list(run.profile.data.hr_size)}
        model, step = DepthModel(card, stage.depth_net.eval(), device="cpu", precision="float32"), state["step"]
        log = pd.read_csv(path.with_name("log.csv")).query("step <= @step")
        minutes = step / log["steps_per_second"].iloc[-1] / 60
    else:
        model, card = load(path, "cpu", "float32"), load_card(path)
        step, minutes = card["steps"], card["seconds_of_last_run"] / 60
    errors = evaluate(model.disparities(scored.paths), scored.truth, kind="disparity", **run.profile.evaluation.model_dump())
    return {"variant": name, "step": step, "minutes": round(float(minutes), 1)} | summary(errors)


def drawn(table: pd.DataFrame, run: Run) -> Figure:
    """Abs Rel and δ<1.25 against minutes, a line a variant; one that starts from another's weights begins where that ended."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axes, metric, title in zip(figure.subplots(1, 2), ("abs_rel", "a1"), ("Abs Rel", "δ<1.25")):
        for name, part in table.groupby("variant", sort=False):
            variant = run.profile.variant(name)
            before = table.loc[table["variant"] == variant.starts_from, "minutes"].max()
            axes.plot(part["minutes"] + (0 if pd.isna(before) else before), part[metric], "o-", markersize=3, label=variant.label)
        axes.set(title=title, xlabel="minutes of training")
        axes.grid(alpha=0.3)
    figure.axes[0].legend(fontsize=8)
    return figure


def save(run: Run, rows: list[dict[str, float]], names: list[str]) -> None:
    """Write the table and the figure `error_by_time`, by variant and step."""
    table = pd.DataFrame(sorted(rows, key=lambda row: (names.index(row["variant"]), row["step"])))
    inputs = [path for name in names if (path := run.weights(name, SEED)).exists()]
    run.save_table(table, "error_by_time", inputs)
    run.save_figure(drawn(table, run), "error_by_time", inputs)


def main() -> None:
    """Score each new checkpoint, and at last the weights; the table and the figure are written anew each time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--profile", default="sample")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    run, done, rows = Run(chosen.profile), set(), []
    weights = {name: run.weights(name, SEED) for name in chosen.variants if run.profile.variant(name)}  # an unknown one is refused
    while not done >= {*weights.values()}:
        for name, last in weights.items():
            for path in [*reversed(checkpoint_paths(last.parent)), *([last] if last.exists() else [])]:
                if path not in done:
                    try:
                        rows.append(score(run, name, path))
                    except (InputError, FileNotFoundError):
                        if path.exists():  # else a training that has just ended deleted it
                            raise
                        continue
                    done.add(path)
                    save(run, rows, chosen.variants)
                    print("{variant}: step {step}, {minutes} min: Abs Rel {abs_rel:.3f}, δ<1.25 {a1:.3f}".format(**rows[-1]), flush=True)
        time.sleep(5)


if __name__ == "__main__":
    with exit_on_input_error():
        main()
