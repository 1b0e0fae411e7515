"""What a training leaves to look at: rows of numbers (CSV and TensorBoard) and pictures."""

import contextlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pandas as pd
from accelerate import Accelerator
from accelerate.utils import gather_object
from torch import Tensor

from dualdepth.files import atomic_path, write_text
from dualdepth.training.stages import StageOutput


class TrainingLog:
    """Rows by step in `log.csv`, the same in TensorBoard, pictures in `panels/`.

    A resumed training drops rows and pictures after its checkpoint and goes on, so a log never holds a step twice. What
    cannot be written is told to `say` and does not stop the training; rows are kept and written with the next.
    """

    def __init__(self, folder: Path, step: int, say: Callable[[str], object] = print) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.folder, self.path, self.say = folder, folder / "log.csv", say
        self.rows = [row for row in pd.read_csv(self.path).to_dict("records") if row["step"] <= step] if self.path.exists() else []
        self.writer = SummaryWriter(str(folder / "tensorboard"), purge_step=step + 1)
        for picture in (folder / "panels").glob("step_*.png"):
            if int(picture.stem[5:]) > step:
                picture.unlink()

    def row(self, step: int, values: dict[str, float]) -> None:
        """Add the numbers of a step."""
        self.rows.append({"step": step} | values)
        with self._warn_of_errors():
            write_text(self.path, pd.DataFrame(self.rows).to_csv(index=False, float_format="%.6g"))
            for name, value in values.items():
                self.writer.add_scalar(name, value, step)

    def panel(self, step: int, output: StageOutput) -> None:
        """Picture of the batch's first sample: target, warped source, depth, error."""
        from matplotlib.figure import Figure

        losses, disparity = output.losses, output.disparity[0, 0]
        drawn = {
            "target": (output.target[0].permute(1, 2, 0), {}),
            "source, warped to the target": (losses.synthesized[0].permute(1, 2, 0).clip(0, 1), {}),
            "disparity / its mean, 0 … 3": (disparity / disparity.mean(), {"cmap": "magma", "vmin": 0, "vmax": 3}),
            "photometric error, 0 … 0.5": (losses.error[0, 0], {"cmap": "viridis", "vmin": 0, "vmax": 0.5}),
        }
        figure = Figure(figsize=(10, 3.4), layout="constrained")
        for axes, (title, (values, style)) in zip(figure.subplots(2, 2).flat, drawn.items()):
            axes.imshow(values.cpu().numpy(), **style)
            axes.set_title(title, fontsize=8, loc="left")
            axes.set_axis_off()
        with self._warn_of_errors():
            with atomic_path(self.folder / "panels" / f"step_{step:07d}.png") as partial:
                figure.savefig(partial, dpi=100)
            self.writer.add_figure("panel", figure, step)

    def last(self) -> dict[str, float]:
        """The losses of the last row, for the weights' card."""
        return {name: self.rows[-1][name] for name in ("loss", "photometric", "smoothness", "feature")} if self.rows else {}

    def close(self) -> None:
        """Flush TensorBoard's file."""
        with self._warn_of_errors():
            self.writer.close()

    @contextlib.contextmanager
    def _warn_of_errors(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self.say(f"warning: the log was not written ({error}); training goes on")


def combine(accelerator: Accelerator, parts: Sequence[dict[str, Tensor]]) -> dict[str, float]:
    """One number for each statistic of a step, from all parts of its batch on all processes: their mean, or the extreme of extremes."""
    rows = [{name: value.item() for name, value in part.items()} for part in parts]
    rows = gather_object(rows) if accelerator.num_processes > 1 else rows

    def one(name: str) -> float:
        values = [row[name] for row in rows]
        return min(values) if name.endswith("_min") else max(values) if name.endswith("_max") else sum(values) / len(values)

    return {name: one(name) for name in rows[0]}
