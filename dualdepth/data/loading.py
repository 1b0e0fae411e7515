"""From triplets to batches. Order and augmentation are functions of (seed, epoch, index), so a resume needs only the step."""

import os
import signal
import threading
from collections.abc import Iterator, Sequence
from typing import Any

import cv2
import numpy as np
import torch
from torch import Tensor
from torch.nn import functional as F
from torch.utils.data import DataLoader, Dataset, Sampler

from dualdepth.data.augmentation import augment
from dualdepth.data.bad_frames import BadFrames
from dualdepth.data.kitti import read_image
from dualdepth.data.triplets import Triplet
from dualdepth.errors import InputError
from dualdepth.sections import Augmentation


class TripletDataset(Dataset):
    """Augmented triplets, asked for by (epoch, index).

    Gives `images` (3, 3, H, W) uint8 (target, previous, next; RGB), `intrinsics` (3, 3) float32 at that size and `name`.
    With `bad_frames`, the place of a triplet that cannot be read is taken by the next one that can.
    """

    def __init__(
        self,
        triplets: Sequence[Triplet],
        hr_size: tuple[int, int],
        augmentation: Augmentation,
        seed: int,
        bad_frames: BadFrames | None = None,
    ) -> None:
        self.triplets, self.hr_size, self.augmentation, self.seed = triplets, hr_size, augmentation, seed
        self.bad_frames = bad_frames

    def __len__(self) -> int:
        return len(self.triplets)

    def __getitem__(self, key: tuple[int, int]) -> dict[str, Any]:
        epoch, index = key
        for place in range(len(self)):
            chosen = (index + place) % len(self)
            try:
                return self._sample(epoch, chosen)
            except InputError as error:
                if self.bad_frames is None:
                    raise
                self.bad_frames.note(self.triplets[chosen].name, str(error))
        raise InputError(f"{self.triplets[0].paths[0].parent}: none of {len(self)} triplets can be read; copy or download them again")

    def _sample(self, epoch: int, index: int) -> dict[str, Any]:
        triplet = self.triplets[index]
        frames = [read_image(path) for path in triplet.paths]
        if len({frame.shape for frame in frames}) > 1:
            sizes = ", ".join(f"{f.shape[1]}×{f.shape[0]}" for f in frames)
            raise InputError(
                f"{triplet.paths[0]}: its triplet has frames of different sizes ({sizes}); put one camera's frames in a folder"
            )
        rng = np.random.default_rng([self.seed, epoch, index])
        images, matrix = augment(frames, triplet.intrinsics, self.hr_size, self.augmentation, rng)
        return {
            "images": torch.from_numpy(np.ascontiguousarray(images.transpose(0, 3, 1, 2))),
            "intrinsics": torch.from_numpy(matrix.astype(np.float32)),
            "name": triplet.name,
        }


class StatelessBatches(Sampler[list[tuple[int, int]]]):
    """Batches of (epoch, index) from optimiser step `start` to `stop`; epoch e is the permutation drawn from (seed, e).

    The last, incomplete batch of an epoch is dropped. A step's batch is cut into `accumulate` parts that come one after the
    other, and each part into equal shares for the processes, so its samples are the same however many there are.

    Raises:
        InputError: fewer samples than a batch.
    """

    def __init__(
        self, samples: int, batch_size: int, seed: int, start: int, stop: int, *, accumulate: int = 1, rank: int = 0, processes: int = 1
    ) -> None:
        if samples < batch_size:
            raise InputError(f"{samples} training triplets are fewer than a batch of {batch_size}: add drives or lower batch_size")
        if batch_size % (accumulate * processes):
            raise InputError(
                f"batch_size {batch_size} cannot be shared by {accumulate} parts × {processes} processes: their product must divide it"
            )
        self.samples, self.batch_size, self.seed = samples, batch_size, seed
        self.start, self.stop, self.accumulate = start, stop, accumulate
        self.rank, self.processes = rank, processes

    def __len__(self) -> int:
        return max(self.stop - self.start, 0) * self.accumulate

    def __iter__(self) -> Iterator[list[tuple[int, int]]]:
        per_epoch = self.samples // self.batch_size
        share = self.batch_size // (self.accumulate * self.processes)
        drawn = -1
        for step in range(self.start, self.stop):
            epoch, position = divmod(step, per_epoch)
            if epoch != drawn:
                order, drawn = np.random.default_rng([self.seed, epoch]).permutation(self.samples), epoch
            for part in range(self.accumulate):
                first = position * self.batch_size + (part * self.processes + self.rank) * share
                yield [(epoch, int(index)) for index in order[first : first + share]]


def make_loader(dataset: TripletDataset, batches: StatelessBatches, workers: int) -> DataLoader:
    """Loader of batches with `workers` processes; each decodes on one thread, so the training keeps its cores, and ends only with it."""
    return DataLoader(
        dataset,
        batch_sampler=batches,
        num_workers=workers,
        worker_init_fn=_begin_worker,
        pin_memory=torch.cuda.is_available(),
        prefetch_factor=4 if workers else None,
    )


def _begin_worker(_: int) -> None:
    cv2.setNumThreads(0)
    torch.set_num_threads(1)
    if hasattr(signal, "sigwaitinfo"):  # not on macOS
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGTERM})
        threading.Thread(target=_heed_parent_alone, args=(os.getppid(),), daemon=True).start()


def _heed_parent_alone(parent: int) -> None:
    """End at the SIGTERM of the training, not at a cluster's notice to all processes: the training still needs samples for its step."""
    while signal.sigwaitinfo({signal.SIGTERM}).si_pid != parent:
        pass
    os._exit(0)


def to_unit(images: Tensor) -> Tensor:
    """Bytes → float32 in [0, 1]."""
    return images.float().div_(255.0)


def low_resolution(images: Tensor) -> Tensor:
    """LR-Net's view (…, 3, H/3, W/3): exactly HR-Net's image (…, 3, H, W) averaged 3×3."""
    return F.avg_pool2d(images.flatten(0, -4), 3).unflatten(0, images.shape[:-3])
