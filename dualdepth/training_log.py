"""What a training leaves to look at: rows of numbers (CSV and TensorBoard) and pictures."""

from pathlib import Path

import pandas as pd
from torch import Tensor

from dualdepth.atomic import write_text
from dualdepth.losses import Losses


class TrainingLog:
    """Rows by step in `log.csv`, the same in TensorBoard, pictures in `panels/`.

    A resumed training drops the rows after its checkpoint and goes on, so a log never holds a step twice.
    """

    def __init__(self, folder: Path, step: int) -> None:
        from torch.utils.tensorboard import SummaryWriter

        self.folder, self.path = folder, folder / "log.csv"
        self.rows = [row for row in read_log(self.path).to_dict("records") if row["step"] <= step] if self.path.exists() else []
        self.writer = SummaryWriter(str(folder / "tensorboard"), purge_step=step)

    def row(self, step: int, values: dict[str, float]) -> None:
        """Add the numbers of a step."""
        self.rows.append({"step": step} | values)
        write_text(self.path, pd.DataFrame(self.rows).to_csv(index=False, float_format="%.6g"))
        for name, value in values.items():
            self.writer.add_scalar(name, value, step)

    def panel(self, step: int, target: Tensor, losses: Losses, disparity: Tensor) -> None:
        """Picture of the batch's first sample: target, warped source, depth, error.

        Args:
            step: steps done.
            target: (3, H, W) in [0, 1].
            losses: of the batch.
            disparity: (1, H, W).
        """
        from dualdepth import plots

        figure = plots.training_panel(
            target.cpu().numpy(), losses.synthesized[0].cpu().numpy(), disparity[0].cpu().numpy(), losses.error[0, 0].cpu().numpy()
        )
        plots.save(figure, self.folder / "panels" / f"step_{step:07d}.png")
        self.writer.add_figure("panel", figure, step)

    def close(self) -> None:
        """Flush TensorBoard's file."""
        self.writer.close()


def read_log(path: str | Path) -> pd.DataFrame:
    """The rows of a training's `log.csv`."""
    return pd.read_csv(path)
