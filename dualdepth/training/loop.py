"""The training loop, the same for both stages: stateless sampling, so that a resume needs only weights, optimiser and step."""

import contextlib
import signal
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import torch
from accelerate import Accelerator, DistributedDataParallelKwargs, PartialState
from accelerate.utils import broadcast_object_list, set_seed
from torch.optim.swa_utils import AveragedModel
from torch.utils.data import DataLoader, default_collate
from tqdm import tqdm

from dualdepth.data.loading import StatelessBatches, TripletDataset, make_loader
from dualdepth.data.triplets import Triplet
from dualdepth.device import (
    choose_precision,
    compute_repeatably,
    default_device,
    device_name,
    is_main_process,
    on_cpu,
    process_count,
)
from dualdepth.errors import InputError, note
from dualdepth.files import check_writable, remove_leftovers
from dualdepth.geometry import to_unit
from dualdepth.networks.depth_nets import DualNet
from dualdepth.profile import Profile
from dualdepth.settings import StageSettings
from dualdepth.training.checkpoints import checkpoint_paths, last_checkpoint, save_checkpoint
from dualdepth.training.log import TrainingLog, combine
from dualdepth.training.stages import Stage, StageOutput
from dualdepth.training.weights import save_weights

CORRIDOR_RATE = 1e-3  # Learning rate while the paper's PoseNet learns alone.
WATCHED = 100  # Step after which slow loading is reported.


def learning_rate(stage: StageSettings, step: int, total: int) -> float:
    """Rate of optimiser step `step` (from 0) of `total`: the paper's steps, stretched in proportion to shorter runs."""
    nominal_epochs = stage.learning_rates[-1][0]
    epoch = step / total * nominal_epochs  # completed nominal epochs, so epoch 10 ends when this reaches 10
    return next((rate for last, rate in stage.learning_rates if epoch < last), stage.learning_rates[-1][1])


def total_steps(stage: StageSettings, samples: int) -> int:
    """Optimiser steps of a stage over `samples` triplets."""
    steps = stage.epochs * (samples // stage.batch_size)
    return min(steps, stage.max_steps) if stage.max_steps is not None else steps


class Trainer:
    """Trains one stage to its end, from its last checkpoint if there is one, and writes `model.safetensors` with its card.

    A checkpoint or a log that cannot be written is a warning, and the training goes on; weights that cannot be are an error, and the last
    checkpoint stays.

    Args:
        make_model, triplets: what builds the stage, and what it is trained on.
        stage, profile: epochs, batch, learning rates, and the rest of the settings.
        folder: of this run; holds `checkpoint_*.pt`, `log.csv`, `panels/`, `tensorboard/`, `model.safetensors`, `model.json`.
        seed: of initialisation, order and augmentation.
        recipe: digest of all that shapes the result; a checkpoint of another recipe is not resumed.

    An `InputError` tells of too few triplets or steps, of a checkpoint that cannot be read, and of a folder that cannot be written.
    """

    def __init__(
        self,
        make_model: Callable[[], Stage],
        stage: StageSettings,
        profile: Profile,
        triplets: Sequence[Triplet],
        folder: str | Path,
        *,
        seed: int,
        recipe: str,
    ) -> None:
        self.stage, self.profile, self.settings, self.triplets = stage, profile, profile.training, triplets
        self.folder, self.seed, self.recipe = Path(folder), seed, recipe
        self.total, self.start, self.saved_at = total_steps(stage, len(triplets)), 0, time.monotonic()
        self.waited = 0.0  # seconds, for batches
        self.dataset = TripletDataset(triplets, profile.data.hr_size, self.settings.augmentation, seed)
        checkpoint = last_checkpoint(self.folder, lambda line: print(line) if is_main_process() else None)
        resumed = bool(checkpoint) and checkpoint["recipe"] == recipe
        chosen = [choose_precision(self.settings.precision, default_device(), profile.data.lr_size)]
        if process_count() > 1:  # machines may differ; the main process chooses for all
            PartialState(cpu=on_cpu())
            broadcast_object_list(chosen)
        self.precision = checkpoint["precision"] if resumed else chosen[0]
        # heads of scales that the loss does not look at get no gradient, nor does a depth network while PoseNet learns alone
        unused = self.settings.loss.scales < 4 or self.settings.beyond_paper_corridor_steps > 0
        ddp = DistributedDataParallelKwargs(find_unused_parameters=unused)
        bf16 = "bf16" if self.precision == "bf16" else "no"
        self.accelerator = Accelerator(cpu=on_cpu(), mixed_precision=bf16, kwargs_handlers=[ddp])
        self.main = self.accelerator.is_main_process
        self.parts = self.settings.accumulate * self.accelerator.num_processes
        """Parts that a batch is cut into; batch norm sees each by itself."""
        if self.main:
            check_writable(self.folder)
            remove_leftovers(self.folder)
        self._prepare(make_model, checkpoint if resumed else None)
        if checkpoint and not resumed:
            step = checkpoint["step"]
            self.accelerator.print(f"{self.folder}: settings or code changed since the checkpoint of step {step}; training from the start")

    def _prepare(self, make_model: Callable[[], Stage], checkpoint: dict[str, Any] | None) -> None:
        """Model and optimiser, new or as the checkpoint has them, on this process's device."""
        set_seed(self.seed)
        compute_repeatably(self.settings.deterministic)
        model = make_model()
        if self.settings.channels_last:
            model = model.to(memory_format=torch.channels_last)
        if self.settings.compile:
            model.forward = torch.compile(model.forward, dynamic=False)
        self.corridor_steps = model.corridor_steps
        after = self.settings.beyond_paper_refined_after
        dual = isinstance(model.depth_net, DualNet)  # in which LR-Net's depth has a shape from the first step
        self.unrefined_steps = self.total if after is None else 0 if dual else after
        if 0 < self.total <= self.corridor_steps:
            corridor = f"beyond_paper_corridor_steps {self.corridor_steps}"
            raise InputError(f"{corridor} leave the depth network none of {self.total} steps: lower them, or train longer")
        self.trained = [p for p in model.parameters() if p.requires_grad]
        optimizer = torch.optim.Adam(self.trained, betas=(self.stage.beta1, self.stage.beta2), fused=True)
        if checkpoint:
            model.load_state_dict(checkpoint["model"])
            optimizer.load_state_dict(checkpoint["optimizer"])
            self.start, parts = checkpoint["step"], checkpoint["parts"]
            self.accelerator.print(f"resuming {self.folder} at step {self.start} of {self.total}, in {self.precision}")
            if parts != self.parts:
                self.accelerator.print(f"batches were cut in {parts}, now in {self.parts}: same samples, other batch norm, other digits")
        self.accelerator.wait_for_everyone()  # all have read what is now removed
        if self.main and not self.start:
            for path in checkpoint_paths(self.folder):
                path.unlink(missing_ok=True)
        if not checkpoint and isinstance(model.depth_net, DualNet):
            keys = next(iter(StatelessBatches(len(self.triplets), self.stage.batch_size, self.seed, 0, 1)))
            first = default_collate([self.dataset[key] for key in keys])
            model.depth_net.begin(to_unit(first["images"][:, 0]))
        self.model, self.optimizer = self.accelerator.prepare(model, optimizer)
        decay, model = self.settings.beyond_paper_average, self.accelerator.unwrap_model(self.model)
        self.average = AveragedModel(model, multi_avg_fn=running_mean(decay), use_buffers=True) if decay else None
        if self.average and checkpoint:
            self.average.load_state_dict(checkpoint["average"])

    def run(self, card: dict[str, Any]) -> Path:
        """Train to the end and write the weights; `card` is what theirs says, beside the training's own facts.

        An `InputError` names a bad image, weights that cannot be written, or the batch of a loss, pose or gradient that is not finite. On
        SIGTERM a checkpoint is written, and then comes `SystemExit`.
        """
        accelerator = self.accelerator
        shares = {"accumulate": self.settings.accumulate, "processes": accelerator.num_processes, "rank": accelerator.process_index}
        samples = StatelessBatches(len(self.triplets), self.stage.batch_size, self.seed, self.start, self.total, **shares)
        plan = f"{self.total} steps in batches of {self.stage.batch_size}, of {len(self.triplets)} triplets"
        accelerator.print(f"{plan}, on {device_name()} in {self.precision}; the bar shows the time left", flush=True)
        batches = one_line_errors(make_loader(self.dataset, samples, self.settings.workers))
        log = TrainingLog(self.folder, self.start, tqdm.write) if self.main else None
        self.model.train()
        began = time.perf_counter()
        name = f"{self.folder.parent.name} {self.folder.name}"
        bar = tqdm(total=self.total, initial=self.start, desc=name, unit="step", disable=not self.main)
        with bar, contextlib.closing(batches), stop_request(accelerator) as stop_requested:
            for step in range(self.start + 1, self.total + 1):
                logged = step % self.settings.log_every == 0 or step in (1, self.total)
                output, statistics = self._step(step, batches, logged)
                bar.update()
                if step == self.start + 1:  # at which the loader's processes begin, and a program may be compiled
                    self.waited, counted_from = 0.0, time.perf_counter()
                if log and step == self.start + WATCHED and (share := self.waited / (time.perf_counter() - counted_from)) > 0.2:
                    mend = f"raise training.workers (now {self.settings.workers}), or put the frames on a faster disk"
                    tqdm.write(f"note: {share:.0%} of the time the training waits for frames; {mend}")
                if logged:
                    values = combine(accelerator, statistics)
                if log and logged:
                    rate = (step - self.start) / (time.perf_counter() - began)
                    log.row(step, values | {"learning_rate": self.optimizer.param_groups[0]["lr"], "steps_per_second": rate})
                    bar.set_postfix(photometric=f"{values['photometric']:.4f}")
                if log and (step % self.settings.panel_every == 0 or step == self.total):
                    log.panel(step, output)
                stopping = stop_requested()
                late = time.monotonic() - self.saved_at > 60 * self.settings.checkpoint_minutes
                if stopping or late or step == self.total or step % self.settings.checkpoint_every == 0:
                    self._save(step)
                if stopping:
                    raise SystemExit(f"stopped at step {step} of {self.total}; run the same command to go on")
        accelerator.wait_for_everyone()
        weights, seconds = self.folder / "model.safetensors", round(time.perf_counter() - began, 1)
        if log:
            facts = {"seed": self.seed, "recipe": self.recipe, "steps": self.total, "seconds_of_last_run": seconds}
            facts |= {"resumed_at": self.start, "device": device_name(), "precision": self.precision, "batch_parts": self.parts}
            log.close()
            kept = self.average.module if self.average else accelerator.unwrap_model(self.model)
            save_weights(weights, kept, card | facts | {"last_losses": log.last()})
        accelerator.wait_for_everyone()
        return weights

    def _step(self, step: int, batches: Iterator[dict[str, Any]], logged: bool) -> tuple[StageOutput, list[dict[str, torch.Tensor]]]:
        """One optimisation step over all parts of its batch: the last part's output, and, where it is logged, each part's statistics."""
        accelerator, accumulate = self.accelerator, self.settings.accumulate
        in_a_corridor, refine = step <= self.corridor_steps, step > self.unrefined_steps
        faster = in_a_corridor and not self.settings.beyond_paper_pose_encoder  # whose ImageNet weights a high rate would spoil
        for group in self.optimizer.param_groups:
            group["lr"] = CORRIDOR_RATE if faster else learning_rate(self.stage, step - 1, self.total)
        self.optimizer.zero_grad()
        names, statistics = [], []
        for part in range(accumulate):
            began = time.perf_counter()
            batch = next(batches)
            self.waited += time.perf_counter() - began
            batch = {k: v.to(accelerator.device, non_blocking=True) if torch.is_tensor(v) else v for k, v in batch.items()}
            names += batch["name"]
            # an encoder's own draws, such as dropout, are functions of seed, step and part, too
            draw = part * accelerator.num_processes + accelerator.process_index
            torch.manual_seed((self.seed * self.total + step) * self.parts + draw)
            with contextlib.nullcontext() if part == accumulate - 1 else accelerator.no_sync(self.model):
                try:
                    output = self.model(batch, in_a_corridor, refine)
                except torch._dynamo.exc.TorchDynamoException as error:  # before anything was computed
                    note(f"training.compile does not work here ({str(error).splitlines()[0]}); training goes on without it")
                    torch.compiler.set_stance("force_eager")
                    output = self.model(batch, in_a_corridor, refine)
                self._check_finite("loss", output.losses.total, step, names)
                self._check_finite("pose", output.poses.sum(), step, names)  # with it all pixels count as unseen, and the loss stays finite
                accelerator.backward(output.losses.total / accumulate)
            if logged:
                statistics.append(output.statistics)
        # a finite loss can have an infinite gradient; caught here, it has not reached the weights
        norm = torch.nn.utils.get_total_norm(p.grad for p in self.trained if p.grad is not None)
        self._check_finite("gradient", norm, step, names)
        self.optimizer.step()
        if self.average and not in_a_corridor:
            self.average.update_parameters(accelerator.unwrap_model(self.model))
        return output, statistics

    def _check_finite(self, what: str, value: torch.Tensor, step: int, names: Sequence[str]) -> None:
        if not torch.isfinite(value):
            # no checkpoint: the forward pass may have spoilt batch norm's statistics; the last one stays
            mend = "look at these frames and their intrinsics, lower training's learning_rates, or set training.precision to float32"
            raise InputError(f"{self.folder}: {what} is {value.item()} at step {step}, frames {', '.join(names)}; {mend}")

    def _save(self, step: int) -> None:
        """Write a checkpoint; one that cannot be written is a warning, since the training is worth more; the next is tried in its time."""
        self.saved_at = time.monotonic()
        if not self.main:
            return
        state = {"recipe": self.recipe, "parts": self.parts, "precision": self.precision, "step": step}
        state |= {"model": self.accelerator.unwrap_model(self.model).state_dict(), "optimizer": self.optimizer.state_dict()}
        state |= {"average": self.average.state_dict()} if self.average else {}
        try:
            save_checkpoint(self.folder, state, self.settings.keep_checkpoints)
        except OSError as error:
            before = checkpoint_paths(self.folder)
            kept = f"the last good one is {before[0].name}" if before else "there is none yet"
            tqdm.write(f"warning: checkpoint of step {step} was not written ({error}); {kept}, training goes on")


def running_mean(decay: float) -> Callable[[Sequence[torch.Tensor], Sequence[torch.Tensor], torch.Tensor], None]:
    """What moves each mean towards the new value, for torch's `AveragedModel`, from the number of values that the means are of.

    Of n values the newest counts for 1 − min(decay, (1 + n) / (10 + n)), so that a short training's mean is over its last ninth.
    """

    def update(means: Sequence[torch.Tensor], values: Sequence[torch.Tensor], number: torch.Tensor) -> None:
        share = max(1.0 - decay, 9.0 / (10.0 + int(number)))
        for mean, value in zip(means, values):
            mean.lerp_(value, share) if mean.is_floating_point() else mean.copy_(value)

    return update


def one_line_errors(loader: DataLoader) -> Iterator[dict[str, Any]]:
    """The loader's batches; a bad image met by a worker process is told without the worker's traceback. At any error the workers end."""
    try:
        yield from loader
    except BaseException as error:
        # they hold the loader's iterator, whose workers end with it alone; this process would wait for them for ever
        traceback.clear_frames(error.__traceback__)
        if isinstance(error, InputError):
            raise InputError(str(error).rsplit("InputError: ", 1)[-1].strip()) from None
        raise


@contextlib.contextmanager
def stop_request(accelerator: Accelerator) -> Iterator[Callable[[], bool]]:
    """Note SIGTERM (a cluster's notice), so that the loop can write a checkpoint at the end of its step.

    Gives a function that says whether any process was told to stop; all of them ask after each step, so that they stop at the same one.
    """
    noted: list[int] = []

    def stop_requested() -> bool:
        if accelerator.num_processes == 1:
            return bool(noted)
        if noted:
            accelerator.set_trigger()
        return accelerator.check_trigger()

    before = None
    with contextlib.suppress(ValueError):  # only a main thread can be told
        before = signal.signal(signal.SIGTERM, lambda number, _: noted.append(number))
    try:
        yield stop_requested
    finally:
        if before is not None:
            signal.signal(signal.SIGTERM, before)
