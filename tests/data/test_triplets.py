"""Which frames are trained on: consecutive, moving, of no test drive."""

import pytest
from small_kitti import DRIVE, write_calibration, write_drive

from dualdepth.data.kitti import Frame, image_path
from dualdepth.data.triplets import drive_triplets, load_triplets, missing_files_error, missing_neighbours, raw_triplets, write_triplets
from dualdepth.errors import InputError

OTHER = "2011_09_28/2011_09_28_drive_0002_sync"


@pytest.fixture
def root(tmp_path):
    write_calibration(tmp_path)
    write_drive(tmp_path, [0, 1, 2, 3, 5, 6, 7, 8], size=(8, 8))
    return tmp_path


def test_targets_have_both_neighbours_in_number_of_the_same_drive_and_none_is_static(root):
    assert [frame.index for frame in drive_triplets(root, [DRIVE])] == [1, 2, 6, 7]
    assert [frame.index for frame in drive_triplets(root, [DRIVE], static={(DRIVE, 3), (OTHER, 6)})] == [1, 6, 7]
    third = "2011_09_26/2011_09_26_drive_0003_sync"
    write_drive(root, [4, 5], OTHER, size=(8, 8))
    write_drive(root, [9], third, size=(8, 8))
    assert {f.drive for f in drive_triplets(root, [DRIVE, OTHER, third])} == {DRIVE}
    with pytest.raises(InputError, match="no three consecutive moving frames"):
        drive_triplets(root, [OTHER])


@pytest.mark.parametrize("entry", [DRIVE, f"{DRIVE}:image_00"])
def test_a_test_drive_is_refused_by_name(root, entry):
    with pytest.raises(InputError, match=f"training drives {DRIVE} hold test frames"):
        drive_triplets(root, [entry], test_scenes={DRIVE})


def test_the_first_camera_that_has_frames_is_read_or_the_one_that_a_drive_names_and_all_drives_without_frames_are_named(root):
    with pytest.raises(InputError, match=f"no frames in {OTHER}/image_02, 2011_09_26/elsewhere/image_02"):
        drive_triplets(root, [DRIVE, OTHER, "2011_09_26/elsewhere"])
    for drive in (DRIVE, OTHER):
        write_drive(root, [0, 1, 2], drive, size=(8, 8), camera="image_00")
    (root / OTHER / "image_02" / "data").mkdir(parents=True)
    found = drive_triplets(root, [DRIVE, OTHER], cameras=("image_02", "image_00"))
    assert {(f.drive, f.camera) for f in found} == {(DRIVE, "image_02"), (OTHER, "image_00")}
    assert drive_triplets(root, [f"{DRIVE}:image_00"], cameras=("image_02", "image_00")) == [Frame(DRIVE, 1, "image_00")]


def test_one_message_names_all_missing_files_in_one_line(root):
    missing = [(frame, frame.camera) for frame in missing_neighbours(root, [Frame(DRIVE, 4), Frame(OTHER, 1), Frame(OTHER, 7)])]
    message = str(missing_files_error("to train on", root, [*missing, (Frame(OTHER, 3), "velodyne_points")]))
    assert "8 files to train on are missing" in message and f"{DRIVE}/image_02/data 0000000004;" in message
    assert f"{OTHER}/image_02/data 0000000000-0000000002, 0000000006-0000000008;" in message
    assert f"{OTHER}/velodyne_points/data 0000000003;" in message and "\n" not in message


@pytest.mark.parametrize("suffixes", [(".png",), (".jpg",), (".jpg", ".png"), (".JPG", ".png", ".PNG", ".Jpg")])
def test_written_targets_read_back_as_triplets_of_real_files(tmp_path, suffixes):
    write_calibration(tmp_path, focal=100.0)
    for first, suffix in enumerate(suffixes):  # a conversion that was stopped leaves both kinds
        write_drive(tmp_path, range(first, 4), size=(8, 8), suffix=suffix)
    targets = drive_triplets(tmp_path, [DRIVE])
    write_triplets(tmp_path / "out/triplets.csv", tmp_path, raw_triplets(tmp_path, targets))
    triplets = load_triplets(tmp_path / "out/triplets.csv", tmp_path)
    assert [(t.name, t.drive) for t in triplets] == [(str(f), DRIVE) for f in targets] and triplets[0].intrinsics[0, 0] == 100
    for triplet, frame in zip(triplets, targets):
        assert triplet.paths == tuple(image_path(tmp_path, frame._replace(index=frame.index + o)) for o in (0, -1, 1))


@pytest.mark.parametrize("content", [None, "a,b\n1,2\n"])
def test_a_list_that_was_not_prepared_names_the_notebook(tmp_path, content):
    if content:
        (tmp_path / "triplets.csv").write_text(content)
    with pytest.raises(InputError, match=r"triplets\.csv: .*02_prepare_data"):
        load_triplets(tmp_path / "triplets.csv", tmp_path)
