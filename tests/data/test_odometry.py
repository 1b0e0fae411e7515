"""Odometry on disk: which triplets there are, with which camera; pose files, both forms; and what a user is told."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation
from small_kitti import write_sequence

from data_scripts.sources import drive_archives
from dualdepth.data import odometry
from dualdepth.data.odometry import Trajectory, odometry_triplets, pair_frames, read_trajectory, sequence_intrinsics, write_trajectory
from dualdepth.data.triplets import load_triplets, write_triplets
from dualdepth.errors import InputError

IDENTITY = "1 0 0 0 0 1 0 0 0 0 1 0"


@pytest.fixture
def root(tmp_path):
    write_sequence(tmp_path, "00", [0, 1, 2, 3, 5, 6, 7])
    folder = tmp_path / "sequences/00/image_2"
    (folder / "000002.png").rename(folder / "000002.PNG")
    for name in ("000002.JPG", "000003.jpg", "000003.jpeg"):
        (folder / name).touch()  # beside a PNG, which wins
    write_sequence(tmp_path, "06", range(3), camera="image_0", calibration="calib_p0_p1.txt")
    return tmp_path


def indexed(root, *entries, broken=()):
    """The triplets of sequences that were written and read, and the names of the sequences."""
    write_triplets(root / "odometry.csv", root, odometry_triplets(root, entries, broken))
    triplets = load_triplets(root / "odometry.csv", root)
    return triplets, sorted({triplet.drive for triplet in triplets})


def test_triplets_are_three_consecutive_frames_of_one_sequence_and_none_is_broken(root):
    triplets, sequences = indexed(root, "00", "06:image_0")
    assert sequences == ["00", "06"] and triplets[-1].name == "odometry/06/image_0/000001"
    numbers = [[int(path.stem) for path in t.paths] for t in triplets]
    assert numbers == [[1, 0, 2], [2, 1, 3], [6, 5, 7], [1, 0, 2]]  # target, previous, next
    assert all(path.suffix.lower() == ".png" and path.is_file() for t in triplets for path in t.paths)
    broken = {root / "sequences/00/image_2/000003.png", root / "sequences/06/image_0/000000.png"}
    assert [t.name[-6:] for t in indexed(root, "00", broken=broken)[0]] == ["000001", "000006"]
    with pytest.raises(InputError, match="sequences/06/image_0: no three consecutive"):
        indexed(root, "06:image_0", broken=broken)


@pytest.mark.parametrize(("entry", "file"), [("00", "calib.txt"), ("06:image_0", "calib_p0_p1.txt")])
def test_the_camera_is_read_from_either_kind_of_calibration_and_what_is_not_there_is_named(root, entry, file):
    assert sequence_intrinsics(root, entry).tolist() == [[220, 0, 104], [0, 221, 103], [0, 0, 1]]
    path = root / "sequences" / entry[:2] / file
    path.write_text(path.read_text().replace("220", "230"))
    assert indexed(root, entry)[0][0].intrinsics.tolist() == [[230, 0, 104], [0, 221, 103], [0, 0, 1]]
    for text in ("1 2 x\n", "1 2 3\n", "", f"P1: {IDENTITY}\n"):
        path.write_text(text)
        with pytest.raises(InputError, match=rf"{file}: "):
            sequence_intrinsics(root, entry)
    with pytest.raises(InputError, match="sequences/03/image_2: no images; download the sequence first"):
        odometry.frame_files(root, "03")
    with pytest.raises(InputError, match="no images; there is image_0, say `06:image_0`"):
        odometry.frame_files(root, "06")


def test_sequences_are_raw_drives_of_kitti_and_streets_of_the_world():
    assert odometry.drives_of(["09", "06:image_0"], world=False) == [f"2011_09_30/2011_09_30_drive_00{k}_sync" for k in (20, 33)]
    assert odometry.drives_of(["09"], world=True) == ["odometry/09"]
    drive_archives(list(odometry.RAW_DRIVES.values()))  # all of them names of raw drives


def test_which_sequences_are_eigen_test_drives(real):
    """By the field's own lists: 00, 04, 05 and 07 are; 09 and 10 are training drives."""
    lists = real("splits/monodepth2")
    tested = {line.split()[0] for line in (lists / "eigen/test_files.txt").read_text().splitlines()}
    trained = {line.split()[0] for line in (lists / "eigen_zhou/train_files.txt").read_text().splitlines()}
    assert {name for name, drive in odometry.RAW_DRIVES.items() if drive in tested} == {"00", "04", "05", "07"}
    assert {name for name, drive in odometry.RAW_DRIVES.items() if drive in trained} >= {"01", "02", "06", "08", "09", "10"}


def test_real_sequences_are_read_by_what_their_folder_holds(real):
    root = real("kitti_odometry")
    entries = sorted(f"{path.parent.name}:{path.name}" for path in root.glob("sequences/*/image_*"))
    files = [{int(path.stem) for path in root.glob(f"sequences/{entry.replace(':', '/')}/*.*")} for entry in entries]
    assert len(odometry_triplets(root, entries)) == sum({i - 1, i + 1} <= there for there in files for i in there)
    for entry in entries:
        (fx, _, cx), (_, fy, cy), _ = sequence_intrinsics(root, entry)
        assert fx == fy and 0.5 < fx / cx / 2 < 0.7 and cy < cx and odometry.poses_path(root, entry).is_file()


def random_poses(count, seed=0):
    rng = np.random.default_rng(seed)
    poses = np.tile(np.eye(4), (count, 1, 1))
    poses[:, :3, :3] = Rotation.random(count, rng=rng).as_matrix()
    poses[:, :3, 3] = rng.normal(0, 100, (count, 3))
    return poses


def trajectory(frames, indexed=True):
    return Trajectory(np.array(frames), random_poses(len(frames)), indexed)


def test_a_line_is_the_3x4_matrix_or_the_4x4_one_row_by_row(tmp_path):
    (tmp_path / "a.txt").write_text("0 -1 0 5 1 0 0 6 0 0 1 7\n\n1.0e+00 0 0 1 0 1 0 2 0 0 1 -3.5\r\n\n")
    read = read_trajectory(tmp_path / "a.txt")
    assert read.frames.tolist() == [0, 1] and not read.indexed and read.poses.dtype == np.float64
    assert read.poses[0].tolist() == [[0, -1, 0, 5], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]
    assert read.poses[1, :3, 3].tolist() == [1, 2, -3.5]
    for frame in ("", "7 "):
        (tmp_path / "a.txt").write_text(f"{frame}0 -1 0 5 1 0 0 6 0 0 1 7 1e-9 0 0 1.0000001")
        whole = read_trajectory(tmp_path / "a.txt")
        assert whole.frames.tolist() == [7 if frame else 0] and np.array_equal(whole.poses[0], read.poses[0])


@pytest.mark.parametrize("numbers", [("2", "3", "70"), ("2.000000e+00", "3.0", "7e1")])
def test_a_13th_number_in_front_is_the_frame(tmp_path, numbers):
    (tmp_path / "a.txt").write_text("".join(f"{n} 1 0 0 {i} 0 1 0 0 0 0 1 0\n" for i, n in enumerate(numbers)))
    read = read_trajectory(tmp_path / "a.txt")
    assert read.indexed and read.frames.tolist() == [2, 3, 70] and read.frames.dtype.kind == "i"
    assert read.poses[:, 0, 3].tolist() == [0, 1, 2]


def test_what_is_written_is_read_without_loss_and_what_cannot_be_is_named(tmp_path):
    poses, path = random_poses(3), tmp_path / "new" / "a.txt"
    write_trajectory(path, poses)
    np.testing.assert_array_equal(read_trajectory(path).poses, poses)
    assert [p.name for p in path.parent.iterdir()] == ["a.txt"]
    with pytest.raises(InputError, match=r"b\.txt: cannot write the poses"):
        write_trajectory(path / "b.txt", poses)


@pytest.mark.parametrize("text", ["{:.6f}", "{:.6e}", "{:.3f}", None])
def test_rotations_of_three_decimals_and_long_products_of_float32_ones_pass(tmp_path, text):
    poses = random_poses(500 if text else 4500)
    for k in range(1, 0 if text else len(poses)):
        step = Rotation.from_euler("yxz", [0.01, 0.003, -0.002]).as_matrix().astype(np.float32)
        poses[k, :3, :3] = poses[k - 1, :3, :3].astype(np.float32) @ step
    rows = [" ".join((text or "{}").format(v) for v in pose[:3].ravel()) for pose in poses]
    (tmp_path / "a.txt").write_text("\n".join(rows))
    np.testing.assert_allclose(read_trajectory(tmp_path / "a.txt").poses, poses, atol=6e-4)


BAD = {
    "tum": ("0.0 1 2 3 0 0 0 1\n", "line 1: 8 numbers, which look like TUM's"),
    "overflow": ("1 0 0 0 0 1 0 1e200 0 0 1 0\n", "line 1: NaN, infinite or beyond"),
    "text": (f"{IDENTITY}\n1 0 0 x 0 1 0 0 0 0 1 0\n", "line 2: cannot be read (ValueError: could not convert string to float: 'x')"),
    "commas": (IDENTITY.replace(" ", ","), "line 1: cannot be read"),
    "mixed, index later": (f"{IDENTITY}\n1 {IDENTITY}\n", "line 2: 13 numbers, 12 in the first line"),
    "mixed, index first": (f"0 {IDENTITY}\n{IDENTITY}\n", "line 2: 12 numbers, 13 in the first line"),
    "no 4x4 matrix": (f"{IDENTITY} 0 0 0 2\n", "line 1: the last 4 of 16 numbers are not 0 0 0 1"),
    "mirrored": ("-1 0 0 0 0 1 0 0 0 0 1 0\n", "line 1: the left 3x4 columns are no rotation"),
    "half a frame": (f"0 {IDENTITY}\n1.5 {IDENTITY}\n", "line 2: the frame number"),
    "negative frame": (f"-1 {IDENTITY}\n", "line 1: the frame number"),
    "frame twice": (f"3 {IDENTITY}\n3 {IDENTITY}\n", "line 2: the frame number is not above"),
    "backwards": (f"3 {IDENTITY}\n4 {IDENTITY}\n2 {IDENTITY}\n", "line 3: the frame number is not above"),
}


@pytest.mark.parametrize(("text", "says"), BAD.values(), ids=BAD)
def test_bad_files_are_one_line_with_file_and_line(tmp_path, text, says):
    (tmp_path / "a.txt").write_text(text)
    with pytest.raises(InputError) as error:
        read_trajectory(tmp_path / "a.txt")
    message = str(error.value)
    assert message.startswith(str(tmp_path / "a.txt")) and says in message and "\n" not in message


def test_poses_are_paired_by_frame_numbers_or_in_order():
    by_number = trajectory([2, 3, 5, 9]), trajectory(range(8), indexed=False), [2, 3, 5]
    in_order = trajectory(range(3), indexed=False), trajectory([5, 6, 8]), [0, 1, 2]
    for prediction, truth, places in (by_number, in_order):
        frames, poses, true_poses = pair_frames(prediction, truth)
        assert frames.tolist() == truth.frames[places].tolist()
        np.testing.assert_array_equal(poses, prediction.poses[:3])
        np.testing.assert_array_equal(true_poses, truth.poses[places])
