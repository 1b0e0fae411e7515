"""Make3D on disk: pairs, laser grids, and photos of which one is truncated."""

import cv2
import numpy as np
import pytest
from scipy.io import savemat

from dualdepth.data.make3d import find_pairs, is_truncated, read_photo
from dualdepth.errors import InputError

NAMES = ("b-p-002t000", "a-p-001t000")


def points(seed=0):
    return np.random.default_rng(seed).uniform(1, 80, (55, 305, 4))


def jpeg(height=96, width=72, seed=0):
    coarse = np.random.default_rng(seed).integers(0, 255, (12, 9, 3), dtype=np.uint8)
    return cv2.imencode(".jpg", cv2.resize(coarse, (width, height)))[1].tobytes()


@pytest.fixture
def make_root(tmp_path):
    def make(photos=NAMES, grids=NAMES, photo_folder="Test134", grid_folder="Gridlaserdata"):
        for folder in (photo_folder, grid_folder):
            (tmp_path / folder).mkdir(parents=True)
        for number, name in enumerate(photos):
            (tmp_path / photo_folder / f"img-{name}.jpg").write_bytes(jpeg(seed=number))
        for number, name in enumerate(grids):
            savemat(tmp_path / grid_folder / f"depth_sph_corr-{name}.mat", {"Position3DGrid": points(number)})
        return tmp_path

    return make


@pytest.mark.parametrize("photo_folder", ["Test134", "Test134Img"])
@pytest.mark.parametrize("grid_folder", ["Gridlaserdata", "Test134Depth", "Test134Depth/Gridlaserdata"])
def test_pairs_are_found_by_name_in_their_order(make_root, photo_folder, grid_folder):
    root = make_root(photo_folder=photo_folder, grid_folder=grid_folder)
    (root / photo_folder / "._img-a-p-001t000.jpg").write_bytes(b"a leftover of another system")
    pairs = find_pairs(root)
    assert [pair.name for pair in pairs] == sorted(NAMES) and pairs[0].photo == root / photo_folder / "img-a-p-001t000.jpg"
    assert pairs[0].grid == root / grid_folder / "depth_sph_corr-a-p-001t000.mat"


@pytest.mark.parametrize(
    ("photos", "grids", "said"),
    [
        (("a", "c", "both"), ("both", "x", "y"), r"depth_sph_corr-x.mat stands alone, .* and 1 more"),
        ((), ("a",), r"holds no Test134/img-\*\.jpg"),
        (("a",), (), r"holds no Gridlaserdata/depth_sph_corr-\*\.mat"),
    ],
)
def test_what_stands_alone_and_folders_without_files_are_named(make_root, photos, grids, said):
    with pytest.raises(InputError, match=f"MAKE3D_ROOT .*{said}"):
        find_pairs(make_root(photos=photos, grids=grids))


@pytest.mark.parametrize("kept", [0.75, 0.999])
def test_a_truncated_photo_keeps_its_size_and_what_is_left(tmp_path, kept):
    whole, path = jpeg(480, 360), tmp_path / "img-a.jpg"
    path.write_bytes(whole[: int(kept * len(whole))])
    photo, full = read_photo(path), cv2.imdecode(np.frombuffer(whole, np.uint8), cv2.IMREAD_COLOR_RGB)
    assert is_truncated(path) and photo.shape == full.shape
    rows = int(0.9 * kept * len(full))
    np.testing.assert_array_equal(photo[:rows], full[:rows])


def test_a_whole_photo_is_decoded_to_rgb_also_with_bytes_after_its_end(tmp_path):
    path = tmp_path / "img-a.jpg"
    path.write_bytes(cv2.imencode(".jpg", np.full((40, 30, 3), (0, 0, 250), np.uint8))[1].tobytes() + b"\0" * 50)
    assert not is_truncated(path) and read_photo(path)[20, 15, 0] > 200 > 50 > read_photo(path)[20, 15, 2]


def test_a_preview_at_the_beginning_does_not_hide_a_missing_end(tmp_path):
    whole, preview, path = jpeg(480, 360), jpeg(24, 18), tmp_path / "img-a.jpg"
    segment = b"\xff\xe1" + (len(preview) + 2).to_bytes(2, "big") + preview
    path.write_bytes(whole[:2] + segment + whole[2:-300])
    assert is_truncated(path) and read_photo(path).shape == (480, 360, 3)
