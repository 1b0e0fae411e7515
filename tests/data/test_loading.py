"""What reaches the networks is a function of (seed, epoch, index), whoever loads it, and the camera matrix is that of the picture."""

from collections import Counter
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import torch
from small_kitti import DRIVE, triplets_of, write_drive

from dualdepth.data.loading import StatelessBatches, TripletDataset, augment, draw_crop, make_loader
from dualdepth.errors import InputError
from dualdepth.settings import Augmentation

HR = (96, 96)
RAW = (100, 330)
K = np.array([[190.0, 0, 171.3], [0, 205.0, 46.8], [0, 0, 1]])


@pytest.fixture
def dataset(kitti_root, tmp_path):
    return TripletDataset(triplets_of(kitti_root, tmp_path), HR, Augmentation(), seed=3)


def batches(steps=range(0, 100), samples=10, batch_size=4, seed=0, **options):
    return list(StatelessBatches(samples, batch_size, seed, steps.start, steps.stop, **options))


def test_a_sample_is_target_previous_next_in_rgb(kitti_root, tmp_path):
    plain = TripletDataset(triplets_of(kitti_root, tmp_path), (208, 208), Augmentation(max_scale=1.0), seed=0)
    sample = plain[0, 1]
    assert sample["images"].shape == (3, 3, 208, 208) and sample["images"].dtype == torch.uint8
    assert sample["name"] == f"{DRIVE}/image_02/0000000002"
    for image, number in zip(sample["images"], (2, 1, 3)):
        file = cv2.imread(str(kitti_root / DRIVE / "image_02/data" / f"{number:010d}.png"))  # BGR
        assert np.array_equal(image.numpy(), file[..., ::-1].transpose(2, 0, 1))
    assert sample["intrinsics"].tolist() == [[220, 0, 104], [0, 220, 104], [0, 0, 1]]


def test_a_sample_is_fixed_by_seed_epoch_and_index_and_each_draws_its_own_crop(dataset):
    again, other = (TripletDataset(dataset.triplets, HR, Augmentation(), seed) for seed in (3, 4))
    for sample in (dataset[1, 2], again[1, 2]):
        assert all(torch.equal(sample[key], dataset[1, 2][key]) for key in ("images", "intrinsics"))
    draws = [dataset[0, 0], dataset[1, 0], dataset[2, 0], other[0, 0], dataset[0, 1]]
    assert len({tuple(d["intrinsics"].flatten().tolist()) for d in draws}) == len(draws)


def test_an_epoch_shows_every_triplet_once_but_an_incomplete_last_batch_in_an_order_of_its_own():
    epoch = [key for batch in batches(range(0, 3), samples=12) for key in batch]
    assert Counter(epoch) == Counter((0, i) for i in range(12))
    found = batches(range(0, 4), samples=10)
    assert [{epoch for epoch, _ in batch} for batch in found] == [{0}, {0}, {1}, {1}] and all(len(set(batch)) == 4 for batch in found)
    orders = [tuple(i for b in batches(range(2 * e, 2 * e + 2), samples=8, seed=s) for _, i in b) for s in (0, 1) for e in (0, 1)]
    assert len(set(orders)) == 4


@pytest.mark.parametrize("start", [1, 2, 3, 7])
@pytest.mark.parametrize("accumulate", [1, 2])
def test_a_resumed_order_goes_on_where_the_first_one_stopped(start, accumulate):
    whole = batches(range(0, 9), accumulate=accumulate)
    assert batches(range(start, 9), accumulate=accumulate) == whole[start * accumulate :]


@pytest.mark.parametrize(("accumulate", "processes"), [(1, 2), (2, 1), (2, 2), (4, 1), (1, 4)])
def test_a_step_has_the_same_samples_whoever_shares_it(accumulate, processes):
    alone = batches(range(0, 5))
    shared = [batches(range(0, 5), accumulate=accumulate, rank=r, processes=processes) for r in range(processes)]
    for step, expected in enumerate(alone):
        parts = [keys for rank in shared for keys in rank[step * accumulate : (step + 1) * accumulate]]
        assert {len(keys) for keys in parts} == {4 // accumulate // processes}
        assert Counter(key for keys in parts for key in keys) == Counter(expected)


def test_a_batch_that_cannot_be_shared_is_an_error():
    with pytest.raises(InputError, match="3 training triplets are fewer than a batch of 4"):
        StatelessBatches(3, 4, 0, 0, 1)
    with pytest.raises(InputError, match="batch_size 4 cannot be shared by 1 parts × 3 processes"):
        StatelessBatches(10, 4, 0, 0, 1, processes=3)


def test_worker_processes_change_nothing(dataset):
    def load(workers, start=0):
        return list(make_loader(dataset, StatelessBatches(3, 1, 3, start, 5), workers))

    alone, helped, resumed = load(0), load(2), load(1, start=2)
    assert [b["name"] for b in alone] == [b["name"] for b in helped]
    assert all(torch.equal(a["images"], b["images"]) for a, b in zip(alone, helped, strict=True))
    assert all(torch.equal(a["images"], b["images"]) for a, b in zip(alone[2:], resumed, strict=True))


@pytest.mark.parametrize("workers", [0, 1, 2])
def test_there_are_no_more_workers_than_shared_memory_has_room_for(dataset, monkeypatch, capsys, workers):
    room = int((workers + 0.5) * 5 * 2 * 9 * HR[0] * HR[1])  # batches of two triplets
    monkeypatch.setattr("shutil.disk_usage", lambda _: SimpleNamespace(free=room))
    assert make_loader(dataset, StatelessBatches(4, 4, 3, 0, 5, accumulate=2), 2).num_workers == workers
    assert (f"/dev/shm has room for {workers} of 2 loader workers" in capsys.readouterr().out) == (workers < 2)


def test_frames_of_different_sizes_are_named(kitti_root, tmp_path):
    triplets = triplets_of(kitti_root, tmp_path)
    write_drive(kitti_root, [3], size=(208, 220))
    dataset = TripletDataset(triplets, HR, Augmentation(), seed=0)
    with pytest.raises(InputError, match=r"0000000002\.png: .*different sizes \(208×208, 208×208, 220×208\)"):
        dataset[0, 1]


def project(matrix, point):
    u, v, w = matrix @ point
    return np.array([u / w, v / w])


def picture_of(point):
    """A bright blob where the camera sees a 3-D point, on black."""
    u, v = project(K, point)
    rows, columns = np.mgrid[: RAW[0], : RAW[1]]
    blob = 250 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / 32)
    return np.repeat(np.rint(blob).astype(np.uint8)[..., None], 3, axis=2)


def centre_of_blob(image):
    grey = image[..., 0].astype(float)
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    return np.array([(columns * grey).sum(), (rows * grey).sum()]) / grey.sum()


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("augment_first", [True, False])
@pytest.mark.parametrize("size", [(96, 288), (192, 576), (96, 384)], ids=["shrunk", "enlarged", "mixed"])
def test_a_point_in_space_stays_on_its_picture(size, augment_first, flip):
    settings = Augmentation(augment_first=augment_first, beyond_paper_flip=flip)
    mirrored = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        point = np.array([*rng.uniform(-0.25, 0.25, 2) * [2, 0.6], 1.0]) * rng.uniform(2, 60)
        raw = picture_of(point)
        images, matrix = augment([raw, raw], K, size, settings, np.random.default_rng(seed))
        shown = size if augment_first else (size[0] // 3, size[1] // 3)
        assert images.shape == (2, *shown, 3)
        # a mirrored picture is that of a mirrored world
        expected = [project(matrix, point), project(matrix, point * [-1, 1, 1])]
        misses = [np.abs(centre_of_blob(images[0]) - place).max() for place in expected]
        mirrored += flip and misses[1] < misses[0]
        assert (min(misses) if flip else misses[0]) < 0.1
    assert mirrored in (range(1, 8) if flip else [0])


def test_crops_show_between_all_and_1_over_max_scale_of_the_frame_in_each_direction():
    rng = np.random.default_rng(0)
    crops = [draw_crop((375, 1242), Augmentation(max_scale=1.15), rng) for _ in range(300)]
    widths, heights = np.array([c.width for c in crops]), np.array([c.height for c in crops])
    for shown, side in ((widths, 1242), (heights, 375)):
        assert side / 1.15 - 0.5 <= shown.min() < side / 1.14 and side / 1.01 < shown.max() <= side
    assert abs(np.corrcoef(widths, heights)[0, 1]) < 0.2  # x and y are drawn independently
    assert all(0 <= c.left <= 1242 - c.width and 0 <= c.top <= 375 - c.height for c in crops)
    assert len({c.left for c in crops}) > 30 and not any(c.flip for c in crops)


def test_without_enlargement_the_whole_frame_is_shown_and_a_triplet_through_one_crop():
    frame = np.random.default_rng(0).integers(0, 256, (*RAW, 3), np.uint8)
    images, matrix = augment([frame], K, (96, 288), Augmentation(max_scale=1.0), np.random.default_rng(5))
    assert np.array_equal(images[0], cv2.resize(frame, (288, 96), interpolation=cv2.INTER_AREA))
    assert np.allclose(matrix[0], [190 * 288 / 330, 0, (171.3 + 0.5) * 288 / 330 - 0.5])
    assert np.allclose(matrix[1], [0, 205 * 0.96, (46.8 + 0.5) * 0.96 - 0.5])
    images, _ = augment([frame, frame, frame], K, (96, 288), Augmentation(beyond_paper_flip=True), np.random.default_rng(1))
    assert np.array_equal(images[0], images[1]) and np.array_equal(images[0], images[2])
