"""The training loop, the same for both stages: stateless sampling, so that a resume needs only weights, optimiser and step."""

import contextlib
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs
from accelerate.utils import set_seed
from torch import nn
from tqdm import tqdm

from dualdepth import ranks
from dualdepth.atomic import check_writable, remove_leftovers
from dualdepth.checkpoints import Checkpointer, checkpoint_paths, last_checkpoint, save_weights
from dualdepth.config import Profile
from dualdepth.data.bad_frames import BadFrames
from dualdepth.data.loading import StatelessBatches, TripletDataset, make_loader
from dualdepth.data.triplets import Triplet
from dualdepth.errors import InputError
from dualdepth.faults import StopRequested, one_line_errors, write_failure
from dualdepth.precision import choose_precision
from dualdepth.results import device_name
from dualdepth.sections import Stage
from dualdepth.training_log import TrainingLog, combine


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

    A checkpoint or a log that cannot be written is a warning, and the training goes on; weights that cannot be are an error, and the last
    checkpoint stays.

    Args:
        make_model: builds the stage from the profile; its forward gives a `StageOutput`.
        stage: epochs, batch, learning rates.
        profile: the rest of the settings.
        triplets: what is trained on.
        folder: of this run; holds `checkpoint_*.pt`, `log.csv`, `panels/`, `tensorboard/`, `model.safetensors`, `model.json`.
        seed: of initialisation, order and augmentation.
        recipe: digest of all that shapes the result; a checkpoint of another recipe is not resumed.
        card: what the weights' card says.

    Returns:
        Path of `model.safetensors`.

    Raises:
        InputError: too few triplets, a bad image, a folder or weights that cannot be written, or a loss or gradient that is not finite
            (with the names of the batch, which is kept in `failure.pt`).
    """
    folder, settings = Path(folder), profile.training
    # heads of scales that the loss does not look at get no gradient
    ddp = DistributedDataParallelKwargs(find_unused_parameters=settings.loss.scales < 4)
    checkpoint = last_checkpoint(folder, lambda line: print(line) if ranks.is_main() else None)
    resumed = bool(checkpoint) and checkpoint["recipe"] == recipe
    device = torch.device("cuda" if torch.cuda.is_available() else "cpu")
    precision = checkpoint["precision"] if resumed else choose_precision(settings.precision, device, profile.data.lr_size)
    accelerator = Accelerator(cpu=ranks.on_cpu(), mixed_precision="bf16" if precision == "bf16" else "no", kwargs_handlers=[ddp])
    main = accelerator.is_main_process
    if main:
        check_writable(folder)
        remove_leftovers(folder)
    set_seed(seed)
    torch.use_deterministic_algorithms(True, warn_only=True)
    model = make_model(profile)
    if settings.channels_last:
        model = model.to(memory_format=torch.channels_last)
    trained = [p for p in model.parameters() if p.requires_grad]
    optimizer = torch.optim.Adam(trained, lr=stage.learning_rates[0][1], betas=(stage.beta1, stage.beta2))
    total, start = total_steps(stage, len(triplets)), 0
    parts = settings.accumulate * accelerator.num_processes  # of a batch; batch norm sees each by itself
    if resumed:
        model.load_state_dict(checkpoint["model"])
        optimizer.load_state_dict(checkpoint["optimizer"])
        start = checkpoint["step"]
        accelerator.print(f"resuming {folder} at step {start} of {total}, in {precision}")
        if checkpoint["parts"] != parts:
            accelerator.print(f"batches were cut in {checkpoint['parts']}, now in {parts}: same samples, other batch norm, other digits")
    elif checkpoint:
        accelerator.print(f"{folder}: settings or code changed since the checkpoint of step {checkpoint['step']}; training from the start")
    bad_frames = BadFrames(folder / "bad_frames.jsonl", settings.max_bad_frames) if settings.on_bad_frame == "skip" else None
    accelerator.wait_for_everyone()  # all have read what is now removed
    if main and not start:
        for path in checkpoint_paths(folder):
            path.unlink(missing_ok=True)
        if bad_frames:
            bad_frames.clear()
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
    accelerator.wait_for_everyone()
    dataset = TripletDataset(triplets, profile.data.hr_size, settings.augmentation, seed, bad_frames)
    loader = make_loader(dataset, batches, settings.workers)
    log = TrainingLog(folder, start, tqdm.write) if main else None
    checkpoints = Checkpointer(folder, settings.checkpoint_every, settings.checkpoint_minutes, settings.keep_checkpoints, tqdm.write)
    model.train()
    began, seconds = time.perf_counter(), 0.0
    bar = tqdm(total=total, initial=start, desc=f"{folder.parent.name} {folder.name}", unit="step", disable=not main)

    def save(step: int) -> None:
        if main:
            checkpoints.save(step, accelerator.unwrap_model(model), optimizer, recipe=recipe, parts=parts, precision=precision)

    def check_finite(what: str, value: torch.Tensor, step: int, names: Sequence[str], batch: dict[str, Any]) -> None:
        if not torch.isfinite(value):
            # no checkpoint: the forward pass may have spoilt batch norm's statistics; the last one stays
            rank = f"_rank{accelerator.process_index}" if accelerator.num_processes > 1 else ""
            kept = write_failure(folder / f"failure{rank}.pt", what, step, names, accelerator.unwrap_model(model), batch, precision)
            raise InputError(
                f"{folder}: {what} is {value.item()} at step {step}, frames {', '.join(names)}; to look into it: dualdepth replay {kept}"
            )

    with bar, StopRequested(accelerator) as stop:
        shares = one_line_errors(loader)
        for step in range(start + 1, total + 1):
            logged = step % settings.log_every == 0 or step in (1, total)
            for group in optimizer.param_groups:
                group["lr"] = learning_rate(stage, step - 1, total)
            optimizer.zero_grad()
            names: list[str] = []
            statistics: list[dict[str, torch.Tensor]] = []
            for part in range(settings.accumulate):
                batch = {k: v.to(accelerator.device) if torch.is_tensor(v) else v for k, v in next(shares).items()}
                names += batch["name"]
                # an encoder's own draws, such as dropout, are functions of seed, step and part, too
                torch.manual_seed((seed * total + step) * parts + part * accelerator.num_processes + accelerator.process_index)
                with contextlib.nullcontext() if part == settings.accumulate - 1 else accelerator.no_sync(model):
                    output = model(batch)
                    check_finite("loss", output.losses.total, step, names, batch)
                    check_finite("pose", output.poses.sum(), step, names, batch)  # its pixels count as unseen, so the loss is blind to it
                    accelerator.backward(output.losses.total / settings.accumulate)
                if logged:
                    statistics.append(output.statistics)
            # a finite loss can have an infinite gradient; caught here, it has not reached the weights
            norm = torch.nn.utils.get_total_norm(p.grad for p in trained if p.grad is not None)
            check_finite("gradient", norm, step, names, batch)
            optimizer.step()
            bar.update()
            if logged:
                values = combine(accelerator, statistics)
            if log and logged:
                rate = (step - start) / (time.perf_counter() - began)
                log.row(step, values | {"learning_rate": optimizer.param_groups[0]["lr"], "steps_per_second": rate})
                bar.set_postfix(photometric=f"{values['photometric']:.4f}")
            if log and (step % settings.panel_every == 0 or step == total):
                log.panel(step, output.target[0], output.losses, output.disparity[0])
            stopping = stop.agreed()
            if checkpoints.due(step) or step == total or stopping:
                save(step)
            if stopping:
                raise SystemExit(f"stopped at step {step} of {total}; run the same command to go on")
        seconds = time.perf_counter() - began
    accelerator.wait_for_everyone()
    weights = folder / "model.safetensors"
    if main:
        done = {"steps": total, "seconds_of_last_run": round(seconds, 1), "resumed_at": start, "device": device_name()}
        done |= {
            "precision": precision,
            "batch_parts": parts,
            "last_losses": log.last(),
            "skipped": bad_frames.reasons() if bad_frames else {},
        }
        log.close()
        save_weights(weights, accelerator.unwrap_model(model), card | {"seed": seed, "recipe": recipe} | done)
        for path in checkpoint_paths(folder):
            path.unlink(missing_ok=True)
    accelerator.wait_for_everyone()
    return weights
