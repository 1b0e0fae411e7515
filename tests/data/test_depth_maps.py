"""Files of ground-truth depth: plain, and in order."""

from contextlib import nullcontext

import numpy as np
import pytest

from dualdepth.data import depth_maps
from dualdepth.errors import InputError

MAPS = [np.arange(12.0).reshape(3, 4), np.ones((2, 5)), np.zeros((1, 1))]


def test_saved_maps_come_back_in_order_as_plain_float32_and_the_same_bytes_twice(tmp_path):
    path, again = tmp_path / "gt.npz", tmp_path / "again.npz"
    assert depth_maps.save_ground_truth(path, iter(MAPS)) == depth_maps.save_ground_truth(again, MAPS) == 3
    assert path.read_bytes() == again.read_bytes() and len(list(tmp_path.iterdir())) == 2
    loaded = depth_maps.load_ground_truth(path)
    assert len(loaded) == 3 and loaded.names == ["000000", "000001", "000002"]
    for written, read in zip(MAPS, loaded):
        assert read.dtype == np.float32
        np.testing.assert_array_equal(read, written)
    with np.load(path, allow_pickle=False) as archive:
        assert archive.files == loaded.names


def test_order_is_the_files_even_where_keys_do_not_sort(tmp_path):
    path = tmp_path / "plain.npz"
    maps = [np.full((2, 2), float(i)) for i in range(12)]
    ways = [lambda: np.savez(path, *maps), lambda: np.savez(path, data=maps), lambda: np.savez(path, data=np.array(maps)[:, None])]
    for write in (*ways, lambda: np.savez(path, maps), lambda: np.savez(path, data=np.array(maps)[..., None])):
        write()
        assert [depth[0, 0] for depth in depth_maps.load_ground_truth(path)] == list(range(12))


@pytest.mark.parametrize(("frames", "places"), [(0, [0, 1, 3]), (3, [0, 1, 2]), (5, [0, 1, 3]), (4, None), (6, None), (697, None)])
def test_a_list_is_that_of_all_frames_or_of_those_with_maps(tmp_path, frames, places):
    depth_maps.save_ground_truth(tmp_path / "gt.npz", MAPS, ["000000", "000001", "000003"], listed=5)
    with nullcontext() if places else pytest.raises(InputError, match=f"list: lists {frames} frames"):
        assert depth_maps.places_of(depth_maps.load_ground_truth(tmp_path / "gt.npz"), frames, "list") == places
