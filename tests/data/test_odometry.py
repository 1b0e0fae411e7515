"""Odometry on disk: which triplets there are, with which camera, and what a user is told."""

from pathlib import Path

import numpy as np
import pytest
from small_kitti import write_sequence

from data_scripts.sources import drive_archives
from dualdepth.data import odometry
from dualdepth.data.odometry import (
    check_odometry_root,
    drives_of,
    frame_files,
    load_odometry_triplets,
    poses_path,
    sequence_intrinsics,
    write_odometry_index,
)
from dualdepth.errors import InputError
from dualdepth.run import project_root

SHARED = project_root().parent / "shared" / "data" / "kitti_odometry"
needs_kitti = pytest.mark.skipif(not SHARED.is_dir(), reason="real KITTI odometry (../shared/data) is not here")


@pytest.fixture
def root(tmp_path):
    write_sequence(tmp_path, "00", [0, 1, 2, 3, 5, 6, 7])
    write_sequence(tmp_path, "06", range(3), camera="image_0", calibration="calib_p0_p1.txt")
    return tmp_path


def test_triplets_are_three_consecutive_frames_of_one_sequence(root):
    assert write_odometry_index(root / "odometry.csv", root, ["00", "06:image_0"]) == 4
    triplets, sequences = load_odometry_triplets(root / "odometry.csv", root)
    assert sequences == ["00", "06"]
    numbers = [[int(path.stem) for path in t.paths] for t in triplets]
    assert numbers == [[1, 0, 2], [2, 1, 3], [6, 5, 7], [1, 0, 2]]  # target, previous, next
    assert all(path.is_file() for t in triplets for path in t.paths)
    assert [t.name for t in triplets][-1] == "odometry/06/image_0/000001"


@pytest.mark.parametrize("entry", ["00", "06:image_0"])
def test_the_camera_is_read_from_either_kind_of_calibration(root, entry):
    expected = [[220, 0, 104], [0, 221, 103], [0, 0, 1]]
    np.testing.assert_array_equal(sequence_intrinsics(root, entry), expected)
    write_odometry_index(root / "odometry.csv", root, [entry])
    np.testing.assert_array_equal(load_odometry_triplets(root / "odometry.csv", root)[0][0].intrinsics, expected)


def test_the_index_changes_with_the_calibration(root):
    write_odometry_index(root / "odometry.csv", root, ["00"])
    before = (root / "odometry.csv").read_bytes()
    path = root / "sequences/00/calib.txt"
    path.write_text(path.read_text().replace("220", "230"))
    write_odometry_index(root / "odometry.csv", root, ["00"])
    assert (root / "odometry.csv").read_bytes() != before


@pytest.mark.parametrize(
    ("entry", "said"),
    [
        ("03", "sequences/03/image_2: no images; download the sequence first"),
        ("06", "no images; there is image_0, say `06:image_0`"),
    ],
)
def test_a_sequence_that_is_not_there_is_named_with_the_mend(root, entry, said):
    with pytest.raises(InputError, match=said):
        frame_files(root, entry)


def test_two_frames_are_no_triplet(root):
    write_sequence(root, "01", [0, 1, 3])
    with pytest.raises(InputError, match="sequences/01/image_2: no three consecutive frames"):
        write_odometry_index(root / "odometry.csv", root, ["00", "01"])
    assert not (root / "odometry.csv").exists()


@pytest.mark.parametrize(("text", "said"), [("1 2 x\n", "has no P0|must be 12"), ("", "has no P0")])
def test_a_bad_calibration_is_named(root, text, said):
    (root / "sequences/06/calib_p0_p1.txt").write_text(text)
    with pytest.raises(InputError, match=f"calib_p0_p1.txt.*({said})"):
        sequence_intrinsics(root, "06:image_0")


def test_a_folder_without_sequences_is_refused(tmp_path):
    with pytest.raises(InputError, match=r"ODOMETRY_ROOT .*sequences"):
        check_odometry_root(tmp_path)


def test_an_index_that_is_none_names_the_notebook(tmp_path):
    with pytest.raises(InputError, match="02_prepare_data"):
        load_odometry_triplets(tmp_path / "odometry.csv", tmp_path)


def test_sequences_are_raw_drives_of_kitti_and_streets_of_the_world():
    assert drives_of(["09", "06:image_0"], world=False) == [
        "2011_09_30/2011_09_30_drive_0020_sync",
        "2011_09_30/2011_09_30_drive_0033_sync",
    ]
    assert drives_of(["09"], world=True) == ["odometry/09"]
    drive_archives(list(odometry.RAW_DRIVES.values()))  # all of them names of raw drives


@needs_kitti
def test_which_sequences_are_eigen_test_drives():
    """PROTOCOLS B3, computed from the lists: 00, 04, 05 and 07 are; 09 and 10 are training drives."""
    lists = Path(SHARED).parent / "splits"
    tested = {line.split()[0] for line in (lists / "monodepth2/eigen/test_files.txt").read_text().splitlines()}
    trained = {line.split()[0] for line in (lists / "monodepth2/eigen_zhou/train_files.txt").read_text().splitlines()}
    assert {name for name, drive in odometry.RAW_DRIVES.items() if drive in tested} == {"00", "04", "05", "07"}
    assert {name for name, drive in odometry.RAW_DRIVES.items() if drive in trained} >= {"01", "02", "06", "08", "09", "10"}


@needs_kitti
def test_the_real_sequence_06_is_grey_and_has_its_own_calibration(tmp_path):
    assert write_odometry_index(tmp_path / "odometry.csv", SHARED, ["06:image_0", "02"]) == 49 + 18
    matrix = sequence_intrinsics(SHARED, "06:image_0")
    np.testing.assert_allclose(matrix[[0, 1, 0, 1], [0, 1, 2, 2]], [707.0912, 707.0912, 601.8873, 183.1104])
    assert poses_path(SHARED, "06:image_0").is_file()
