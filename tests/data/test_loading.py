"""What reaches the networks is a function of (seed, epoch, index), whoever loads it."""

from collections import Counter

import cv2
import numpy as np
import pytest
import torch
from small_kitti import DRIVE, write_drive

from dualdepth.data.kitti import read_image
from dualdepth.data.loading import StatelessBatches, TripletDataset, make_loader
from dualdepth.data.triplets import Triplet, drive_triplets, load_triplets, write_targets
from dualdepth.errors import InputError
from dualdepth.geometry import low_resolution, to_unit
from dualdepth.settings import Augmentation

HR = (96, 96)


def triplets_of(root, tmp_path):
    path = tmp_path / "triplets.csv"
    write_targets(path, root, drive_triplets(root, [DRIVE]))
    return load_triplets(path, root)


@pytest.fixture
def dataset(kitti_root, tmp_path):
    return TripletDataset(triplets_of(kitti_root, tmp_path), HR, Augmentation(), seed=3)


def same(a, b):
    return torch.equal(a["images"], b["images"]) and torch.equal(a["intrinsics"], b["intrinsics"]) and a["name"] == b["name"]


def batches(steps=range(0, 100), samples=10, batch_size=4, seed=0, **options):
    return list(StatelessBatches(samples, batch_size, seed, steps.start, steps.stop, **options))


def test_the_low_resolution_image_is_the_high_resolution_one_averaged_3_by_3():
    images = torch.from_numpy(np.random.default_rng(0).integers(0, 256, (2, 3, 3, 12, 18), np.uint8))
    found = low_resolution(to_unit(images))
    blocks = images.numpy().astype(np.float64).reshape(2, 3, 3, 4, 3, 6, 3).mean((4, 6)) / 255
    assert found.shape == (2, 3, 3, 4, 6)
    assert np.allclose(found.numpy(), blocks, atol=1e-6)


def test_a_sample_is_target_previous_next_in_rgb(kitti_root, tmp_path):
    plain = TripletDataset(triplets_of(kitti_root, tmp_path), (208, 208), Augmentation(max_scale=1.0), seed=0)
    sample = plain[0, 1]
    assert sample["images"].shape == (3, 3, 208, 208)
    assert sample["images"].dtype == torch.uint8
    assert sample["name"] == f"{DRIVE}/image_02/0000000002"
    for image, number in zip(sample["images"], (2, 1, 3)):
        file = cv2.imread(str(kitti_root / DRIVE / "image_02/data" / f"{number:010d}.png"))  # BGR
        assert np.array_equal(image.numpy(), file[..., ::-1].transpose(2, 0, 1))
    assert sample["intrinsics"].tolist() == [[220, 0, 104], [0, 220, 104], [0, 0, 1]]


def test_a_sample_is_fixed_by_seed_epoch_and_index(dataset):
    assert same(dataset[1, 2], dataset[1, 2])
    again = TripletDataset(dataset.triplets, HR, Augmentation(), seed=3)
    assert same(again[1, 2], dataset[1, 2])


def test_epochs_and_seeds_and_samples_draw_their_own_windows(dataset):
    other = TripletDataset(dataset.triplets, HR, Augmentation(), seed=4)
    draws = [dataset[0, 0], dataset[1, 0], dataset[2, 0], other[0, 0], dataset[0, 1]]
    assert len({tuple(d["intrinsics"].flatten().tolist()) for d in draws}) == len(draws)


def test_an_epoch_shows_every_triplet_once():
    epoch = [key for batch in batches(range(0, 3), samples=12) for key in batch]
    assert Counter(epoch) == Counter((0, i) for i in range(12))


def test_an_incomplete_last_batch_is_left_out():
    found = batches(range(0, 4), samples=10)
    assert [{epoch for epoch, _ in batch} for batch in found] == [{0}, {0}, {1}, {1}]
    assert all(len(set(batch)) == 4 for batch in found)


def test_epochs_and_seeds_have_their_own_order():
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


def test_the_length_is_the_number_of_batches_to_come():
    for options in ({}, {"accumulate": 2}, {"processes": 2}):
        sampler = StatelessBatches(10, 4, 0, 3, 8, **options)
        assert len(sampler) == len(list(sampler))
    assert len(StatelessBatches(10, 4, 0, 8, 8)) == 0


def test_fewer_triplets_than_a_batch_are_an_error():
    with pytest.raises(InputError, match="3 training triplets are fewer than a batch of 4"):
        StatelessBatches(3, 4, 0, 0, 1)


def test_a_batch_that_cannot_be_shared_is_an_error():
    with pytest.raises(InputError, match="batch_size 4 cannot be shared by 1 parts × 3 processes"):
        StatelessBatches(10, 4, 0, 0, 1, processes=3)


def test_worker_processes_change_nothing(dataset):
    def load(workers, start=0):
        return list(make_loader(dataset, StatelessBatches(3, 1, 3, start, 5), workers))

    alone, helped, resumed = load(0), load(2), load(1, start=2)
    assert [b["name"] for b in alone] == [b["name"] for b in helped]
    assert all(torch.equal(a["images"], b["images"]) for a, b in zip(alone, helped, strict=True))
    assert all(torch.equal(a["images"], b["images"]) for a, b in zip(alone[2:], resumed, strict=True))


def test_grey_frames_are_read_as_colour(tmp_path):
    paths = []
    for i in range(3):
        paths.append(tmp_path / f"{i}.png")
        cv2.imwrite(str(paths[-1]), np.full((120, 120), 40 * i, np.uint8))
    sample = TripletDataset([Triplet("grey", tuple(paths), np.eye(3))], HR, Augmentation(), seed=0)[0, 0]
    assert read_image(paths[1]).shape == (120, 120, 3)
    assert [image.unique().tolist() for image in sample["images"]] == [[0], [40], [80]]


def test_frames_of_different_sizes_are_named(kitti_root, tmp_path):
    triplets = triplets_of(kitti_root, tmp_path)
    write_drive(kitti_root, [3], size=(208, 220))
    dataset = TripletDataset(triplets, HR, Augmentation(), seed=0)
    with pytest.raises(InputError, match=r"0000000002\.png: .*different sizes \(208×208, 208×208, 220×208\)"):
        dataset[0, 1]
