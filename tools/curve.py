"""Error against time while trainings run, scored on a run's frames from their checkpoints; the trainings are not touched.

python -m tools.curve lr_plain lr dual --profile sample

Run it beside the chain: a finished training deletes its checkpoints. The curve is for looking: what counts is the last step.
"""

import argparse
import contextlib
import time
from pathlib import Path

import pandas as pd
import torch
from matplotlib.figure import Figure

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import evaluate, summary
from dualdepth.model import DepthModel
from dualdepth.run import Run
from dualdepth.tables.scores import Scored
from dualdepth.training.checkpoints import checkpoint_paths, load_checkpoint
from dualdepth.training.variants import make_stage, start_weights

FINISHED = "model.safetensors"


def score(run: Run, name: str, checkpoint: Path) -> dict[str, float]:
    """Errors of the weights that a training would keep if it ended at this checkpoint, and the minutes that it took until then."""
    state = load_checkpoint(checkpoint)
    stage = make_stage(run.profile, name, start_weights(run, name, 0))
    weights = {key.removeprefix("module."): value for key, value in state.get("average", state["model"]).items() if key != "n_averaged"}
    stage.load_state_dict(weights)
    card = run.profile.architecture(name).model_dump() | {"hr_size": list(run.profile.data.hr_size)}
    scored = Scored(run)
    disparities = DepthModel(card, stage.depth_net.eval(), device="cpu", precision=state["precision"]).disparities(scored.paths)
    errors = evaluate(disparities, scored.truth, kind="disparity", **run.profile.evaluation.model_dump())
    log = pd.read_csv(checkpoint.with_name("log.csv"))
    row = log[log["step"] <= state["step"]].iloc[-1]
    minutes = state["step"] / row["steps_per_second"] / 60  # of a training that was never resumed
    return {"variant": name, "step": state["step"], "minutes": round(float(minutes), 1)} | summary(errors)


def drawn(table: pd.DataFrame) -> Figure:
    """Abs Rel and δ<1.25 against minutes, a line a variant."""
    figure = Figure(figsize=(9, 3.2), layout="constrained")
    for axes, metric, title in zip(figure.subplots(1, 2), ("abs_rel", "a1"), ("Abs Rel", "δ<1.25")):
        for name, part in table.groupby("variant", sort=False):
            axes.plot(part["minutes"], part[metric], "o-", markersize=3, label=name)
        axes.set(title=title, xlabel="minutes of training")
        axes.grid(alpha=0.3)
    figure.axes[0].legend()
    return figure


def main() -> None:
    """Score each new checkpoint until the trainings are done; the table and the figure are written anew each time."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("variants", nargs="+")
    parser.add_argument("--profile", default="sample")
    chosen = parser.parse_args()
    torch.set_num_threads(1)
    run, done, rows = Run(chosen.profile), set(), []
    while not all((run.training(name, 0) / FINISHED).exists() for name in chosen.variants):
        time.sleep(5)
        for name in chosen.variants:
            for path in sorted(set(checkpoint_paths(run.training(name, 0))) - done):
                with contextlib.suppress(InputError, FileNotFoundError):  # it has just been deleted
                    rows.append(score(run, name, path))
                    print("{variant}: step {step}, {minutes} min, Abs Rel {abs_rel:.3f}, δ<1.25 {a1:.3f}".format(**rows[-1]), flush=True)
                done.add(path)
        if rows:
            table = pd.DataFrame(sorted(rows, key=lambda row: (chosen.variants.index(row["variant"]), row["step"])))
            run.save_table(table, "error_by_time", [])
            run.save_figure(drawn(table), "error_by_time", [])


if __name__ == "__main__":
    main()
