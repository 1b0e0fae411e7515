"""From triplets to batches: random scale and crop at full resolution, then one resample to HR-Net's size (paper, "Implementation Details").

Order and augmentation are functions of (seed, epoch, index), so a resume needs only the step.
"""

import shutil
import signal
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import torch
from torch.utils.data import DataLoader, Dataset, Sampler

from dualdepth.data.frames import resample
from dualdepth.data.kitti import read_image
from dualdepth.data.triplets import Triplet
from dualdepth.errors import InputError
from dualdepth.settings import Augmentation


class Crop(NamedTuple):
    """The part of a frame that is seen, in whole pixels, and whether it is mirrored."""

    left: int
    top: int
    width: int
    height: int
    flip: bool = False


def draw_crop(size: tuple[int, int], settings: Augmentation, rng: np.random.Generator) -> Crop:
    """Draw a crop of a frame of `size` (height, width).

    Enlarging by s and cropping back to the frame's size shows a window of 1/s of it; x and y are drawn independently,
    s ~ U(1, max_scale), as in SfMLearner and GeoNet. Whole pixels keep the intrinsics exact.
    """
    height, width = size
    scale_x, scale_y = rng.uniform(1.0, settings.max_scale, 2)
    window_width, window_height = round(width / scale_x), round(height / scale_y)
    left = int(rng.integers(0, width - window_width + 1))
    top = int(rng.integers(0, height - window_height + 1))
    flip = settings.beyond_paper_flip and bool(rng.random() < 0.5)
    return Crop(left, top, window_width, window_height, flip)


def crop_intrinsics(matrix: np.ndarray, crop: Crop, size: tuple[int, int]) -> np.ndarray:
    """Intrinsics (3, 3) of a crop resampled to `size`: the principal point moves with the crop, then all scale about pixel centres."""
    scale_x, scale_y = size[1] / crop.width, size[0] / crop.height
    result = matrix.astype(np.float64).copy()
    result[0, 2] = (result[0, 2] - crop.left + 0.5) * scale_x - 0.5
    result[1, 2] = (result[1, 2] - crop.top + 0.5) * scale_y - 0.5
    result[0, 0] *= scale_x
    result[1, 1] *= scale_y
    if crop.flip:
        result[0, 2] = size[1] - 1 - result[0, 2]
    return result


def augment(
    frames: Sequence[np.ndarray], matrix: np.ndarray, size: tuple[int, int], settings: Augmentation, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """One draw for all frames of a triplet, (H, W, 3) uint8 of one size: (len(frames), h, w, 3) uint8, and the view's intrinsics (3, 3).

    `matrix` are those of the raw frame; `size` is the HR size (height, width). With `augment_first` off (the order the paper calls worse)
    frames are first shrunk to a third of it, the LR size, and cropped there; the result then has the LR size. `rng` fixes the draw.
    """
    if not settings.augment_first:
        size = (size[0] // 3, size[1] // 3)
        matrix = crop_intrinsics(matrix, Crop(0, 0, *frames[0].shape[1::-1]), size)
        frames = [resample(frame, size) for frame in frames]
    crop = draw_crop(frames[0].shape[:2], settings, rng)
    window = np.s_[crop.top : crop.top + crop.height, crop.left : crop.left + crop.width]
    images = [resample(frame[window], size)[:, :: -1 if crop.flip else 1] for frame in frames]
    return np.stack(images), crop_intrinsics(matrix, crop, size)


class TripletDataset(Dataset):
    """Augmented triplets, asked for by (epoch, index).

    Gives `images` (3, 3, H, W) uint8 (target, previous, next; RGB), `intrinsics` (3, 3) float32 at that size and `name`.
    """

    def __init__(self, triplets: Sequence[Triplet], hr_size: tuple[int, int], augmentation: Augmentation, seed: int) -> None:
        self.triplets, self.hr_size, self.augmentation, self.seed = triplets, hr_size, augmentation, seed

    def __len__(self) -> int:
        return len(self.triplets)

    def __getitem__(self, key: tuple[int, int]) -> dict[str, Any]:
        epoch, index = key
        triplet = self.triplets[index]
        frames = [read_image(path) for path in triplet.paths]
        if len({frame.shape for frame in frames}) > 1:
            sizes = ", ".join(f"{f.shape[1]}×{f.shape[0]}" for f in frames)
            raise InputError(f"{triplet.paths[0]}: a triplet of different sizes ({sizes}); put one camera's frames in a folder")
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
    other, and each part into equal shares for the processes, so its samples are the same however many there are. An `InputError` says
    that there are fewer samples than a batch, or that it cannot be shared so.
    """

    def __init__(
        self, samples: int, batch_size: int, seed: int, start: int, stop: int, *, accumulate: int = 1, rank: int = 0, processes: int = 1
    ) -> None:
        if samples < batch_size:
            raise InputError(f"{samples} training triplets are fewer than a batch of {batch_size}: add drives or lower batch_size")
        if batch_size % (accumulate * processes):
            shares = f"{accumulate} parts × {processes} processes"
            raise InputError(f"batch_size {batch_size} cannot be shared by {shares}: their product must divide it")
        self.samples, self.batch_size, self.seed = samples, batch_size, seed
        self.start, self.stop, self.accumulate = start, stop, accumulate
        self.rank, self.processes = rank, processes

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
    """Loader with `workers` processes, or what shared memory has room for (of a container 64 MB); each decodes on one thread, so the
    training keeps its cores, and ends only with it."""
    size = 9 * dataset.hr_size[0] * dataset.hr_size[1] * batches.batch_size // batches.accumulate  # bytes of a batch, of all processes
    shared = Path("/dev/shm")  # where, of each worker, four batches wait and one is in use
    if workers and shared.is_dir() and (fit := shutil.disk_usage(shared).free // (5 * size)) < workers:
        print(f"note: {shared} has room for {fit} of {workers} loader workers; `docker run --shm-size 2g` gives more", flush=True)
        workers = fit
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
    # a cluster's notice goes to all processes, and the training still needs samples for its last step
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
