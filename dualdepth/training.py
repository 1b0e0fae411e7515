"""The training loop, the same for both stages: stateless sampling, so that a resume needs only weights, optimiser and step."""

import contextlib
import signal
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator
from accelerate.utils import set_seed
from torch import nn
from tqdm import tqdm

from dualdepth.checkpoints import load_checkpoint, save_checkpoint, save_weights
from dualdepth.config import Profile
from dualdepth.data.loading import StatelessBatches, TripletDataset, make_loader
from dualdepth.data.triplets import Triplet
from dualdepth.errors import InputError
from dualdepth.results import device_name
from dualdepth.sections import Stage
from dualdepth.training_log import TrainingLog


def learning_rate(stage: Stage, step: int, total: int) -> float:
    """Rate of optimiser step `step` (from 0) of `total`: the paper's steps, stretched in proportion to shorter runs."""
    nominal_epochs = stage.learning_rates[-1][0]
    epoch = step / total * nominal_epochs  # completed nominal epochs, so epoch 10 ends when this reaches 10
    return next((rate for last, rate in stage.learning_rates if epoch < last), stage.learning_rates[-1][1])


def total_steps(stage: Stage, samples: int) -> int:
    """Optimiser steps of a stage over `samples` triplets."""
    steps = stage.epochs * (samples // stage.batch_size)
    return min(steps, stage.max_steps) if stage.max_steps is not None else steps


def train(
    make_model: Callable[[Profile], nn.Module],
    stage: Stage,
    profile: Profile,
    triplets: Sequence[Triplet],
    folder: str | Path,
    *,
    seed: int,
    recipe: str,
    card: dict[str, Any],
) -> Path:
    """Train one stage to its end, from its last checkpoint if there is one, and write `model.safetensors` with its card.

    Args:
        make_model: builds the stage from the profile; its forward gives a `StageOutput`.
        stage: epochs, batch, learning rates.
        profile: the rest of the settings.
        triplets: what is trained on.
        folder: of this run; holds `checkpoint.pt`, `log.csv`, `panels/`, `tensorboard/`, `model.safetensors`, `model.json`.
        seed: of initialisation, order and augmentation.
        recipe: digest of all that shapes the result; a checkpoint of another recipe is not resumed.
        card: what the weights' card says.

    Returns:
        Path of `model.safetensors`.

    Raises:
        InputError: too few triplets, a bad image, or a loss that is not finite (with the names of the batch).
    """
    folder, settings = Path(folder), profile.training
    folder.mkdir(parents=True, exist_ok=True)
    accelerator = Accelerator(mixed_precision="bf16" if settings.precision == "bf16" else "no")
    set_seed(seed)
    torch.use_deterministic_algorithms(True, warn_only=True)
    model = make_model(profile)
    if settings.channels_last:
        model = model.to(memory_format=torch.channels_last)
    trained = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(trained, lr=stage.learning_rates[0][1], betas=(stage.beta1, stage.beta2))
    total, start = total_steps(stage, len(triplets)), 0
    checkpoint = load_checkpoint(folder / "checkpoint.pt")
    if checkpoint and checkpoint["recipe"] == recipe:
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        start = checkpoint["step"]
        accelerator.print(f"resuming {folder} at step {start} of {total}")
    elif checkpoint:
        accelerator.print(f"{folder}: settings or code changed since the checkpoint of step {checkpoint['step']}; training from the start")
    model, optimizer = accelerator.prepare(model, optimizer)

    batches = StatelessBatches(
        len(triplets),
        stage.batch_size,
        seed,
        start,
        total,
        accumulate=settings.accumulate,
        rank=accelerator.process_index,
        processes=accelerator.num_processes,
    )
    dataset = TripletDataset(triplets, profile.data.hr_size, settings.augmentation, seed)
    loader = make_loader(dataset, batches, settings.workers)
    log = TrainingLog(folder, start) if accelerator.is_main_process else None
    model.train()
    began, seconds = time.perf_counter(), 0.0
    bar = tqdm(total=total, initial=start, desc=f"{folder.parent.name} {folder.name}", unit="step", disable=not accelerator.is_main_process)

    def save(step: int) -> None:
        if accelerator.is_main_process:
            inner = accelerator.unwrap_model(model)
            save_checkpoint(folder / "checkpoint.pt", recipe=recipe, step=step, model=inner, optimizer=optimizer)

    def check_finite(what: str, value: torch.Tensor, step: int, names: Sequence[str]) -> None:
        if not torch.isfinite(value):
            # not saved: the forward pass may have spoilt batch norm's statistics; the last checkpoint stays
            raise InputError(f"{folder}: {what} is {value.item()} at step {step}, frames {', '.join(names)}")

    with bar, _StopRequested() as stop:
        parts = _one_line_errors(loader)
        for step in range(start + 1, total + 1):
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(stage, step - 1, total)
            optimizer.zero_grad()
            names: list[str] = []
            for part in range(settings.accumulate):
                batch = {k: v.to(accelerator.device) if torch.is_tensor(v) else v for k, v in next(parts).items()}
                names += batch["name"]
                with contextlib.nullcontext() if part == settings.accumulate - 1 else accelerator.no_sync(model):
                    output = model(batch)
                    check_finite("loss", output.losses.total, step, names)
                    accelerator.backward(output.losses.total / settings.accumulate)
            # a finite loss can have an infinite gradient; caught here, it has not reached the weights
            check_finite("gradient", torch.nn.utils.get_total_norm(p.grad for p in trained if p.grad is not None), step, names)
            optimizer.step()
            bar.update()
            if log and (step % settings.log_every == 0 or step == 1 or step == total):
                values = {k: v.item() for k, v in output.statistics.items()}
                rate = (step - start) / (time.perf_counter() - began)
                log.row(step, values | {"learning_rate": optimizer.param_groups[0]["lr"], "steps_per_second": rate})
                bar.set_postfix(photometric=f"{values['photometric']:.4f}")
            if log and (step % settings.panel_every == 0 or step == total):
                log.panel(step, output.target[0], output.losses, output.disparity[0])
            if (step % settings.checkpoint_every == 0 and step < total) or stop.requested:
                save(step)
            if stop.requested:
                raise SystemExit(f"stopped at step {step} of {total}; run the same command to go on")
        seconds = time.perf_counter() - began
    weights = folder / "model.safetensors"
    if accelerator.is_main_process:
        done = {"steps": total, "seconds_of_last_run": round(seconds, 1), "resumed_at": start, "device": device_name()}
        save_weights(weights, accelerator.unwrap_model(model), card | {"seed": seed, "recipe": recipe} | done)
        (folder / "checkpoint.pt").unlink(missing_ok=True)
        log.close()
    accelerator.wait_for_everyone()
    return weights


def _one_line_errors(loader):
    """The loader's batches; a bad image met by a worker process is told without the worker's traceback."""
    try:
        yield from loader
    except InputError as error:
        raise InputError(str(error).rsplit("InputError: ", 1)[-1].strip()) from None


class _StopRequested:
    """Notes SIGTERM (a cluster's notice), so that the loop can write a checkpoint at the end of its step."""

    def __enter__(self) -> "_StopRequested":
        self.requested = False
        try:
            self.before = signal.signal(signal.SIGTERM, self._note)
        except ValueError:  # not the main thread: nobody can send us signals
            self.before = None
        return self

    def _note(self, *_: object) -> None:
        self.requested = True

    def __exit__(self, *_: object) -> None:
        if self.before is not None:
            signal.signal(signal.SIGTERM, self.before)
