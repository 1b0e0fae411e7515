"""The written world: KITTI's layout and formats read by the readers of real KITTI, the same bytes twice, made once."""

import functools
import json
import shutil

import cv2
import numpy as np
import pytest
from scipy.io import loadmat

from data_scripts import make_miniature
from data_scripts.miniature import formats
from data_scripts.miniature.plan import plan_world
from data_scripts.miniature.render import grid_intrinsics
from dualdepth.data import kitti
from dualdepth.data.lidar import ground_truth
from dualdepth.errors import InputError
from dualdepth.files import locked
from dualdepth.profile import load_profile
from dualdepth.settings import World

SIZES = {"size": (48, 152), "frames_per_drive": 8, "static_frames": 4, "laser_train_frames": 2, "azimuth_step": 1.0, "test_drives": 1}
SIZES |= {"test_frames": 2, "odometry_frames": 4, "odometry_spacing": 20.0, "odometry_path": 251.0, "odometry_test": 1}
SIZES |= {"make3d_images": 1, "make3d_size": (140, 105)}
WORLD = load_profile("tiny").world.model_copy(update=SIZES)
LEAST = WORLD.model_copy(
    update={"train_drives": 1, "frames_per_drive": 3, "static_frames": 2, "test_frames": 1, "odometry_train": 0, "odometry_test": 0}
)


make = functools.partial(make_miniature.make_world, processes=1)


@pytest.fixture(scope="module")
def root(tmp_path_factory):
    out = tmp_path_factory.mktemp("world") / "miniature"
    assert make(WORLD, out)
    return out


@pytest.fixture(scope="module")
def least(tmp_path_factory):
    out = tmp_path_factory.mktemp("least") / "miniature"
    make(LEAST, out)
    return out


def contents(folder):
    return {str(path.relative_to(folder)): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def test_lists_name_what_is_there_and_the_readers_of_kitti_read_it(root):
    raw = kitti.check_root(root / "kitti_raw")
    test = kitti.read_frame_list(root / "lists" / "test_files.txt")
    train = (root / "lists" / "train_drives.txt").read_text().split()
    assert len(test) == WORLD.test_drives * WORLD.test_frames and len(train) == WORLD.train_drives
    assert kitti.read_test_scenes(root / "lists" / "test_scenes.txt") == {frame.drive for frame in test}
    assert not {frame.drive for frame in test} & set(train)
    frames = test + [kitti.Frame(drive, k) for drive in train for k in range(WORLD.frames_per_drive)]
    for frame in frames:
        assert kitti.read_image(kitti.image_path(raw, frame)).shape == (*WORLD.size, 3)
    assert len(list(raw.rglob("*.png"))) == len(frames)
    assert [len(list((raw / drive).rglob("*.bin"))) for drive in train] == [WORLD.laser_train_frames] * len(train)
    assert all(kitti.velodyne_path(raw, frame).is_file() for frame in test)


def test_every_test_frame_has_labels_depth_and_laser_ground_truth_that_fit_together(root):
    for frame in kitti.read_frame_list(root / "lists" / "test_files.txt"):
        drive = frame.drive.split("/")[1]
        labels = cv2.imread(str(root / "labels" / drive / f"{frame.index:010d}.png"), cv2.IMREAD_UNCHANGED)
        dense = np.load(root / "dense_depth" / drive / f"{frame.index:010d}.npy")
        assert labels.dtype == np.uint8 and labels.shape == dense.shape == WORLD.size
        assert {0, 1, 8, 10} <= set(np.unique(labels)) <= {0, 1, 2, 4, 5, 7, 8, 9, 10, 13}
        assert ((labels == 10) == (dense == 0)).all() and (dense[labels == 0] < 400).all()
        # The field's map is shifted by a pixel and holds laser-forward depth (docs/protocols.md): compare with the neighbours.
        sparse = ground_truth(root / "kitti_raw", frame)[: WORLD.size[0] - 2, : WORLD.size[1] - 2]
        rows, columns = np.nonzero(sparse)
        around = np.stack([dense[rows + i, columns + j] for i in (0, 1, 2) for j in (0, 1, 2)])
        low, high, laser = np.where(around > 0, around, np.inf).min(0), around.max(0), sparse[rows, columns]
        assert rows.size > 300 and ((laser > 0.94 * low - 0.4) & (laser < 1.06 * high + 0.4)).mean() > 0.95


def test_camera_stands_still_where_the_static_list_says_and_nowhere_else(root):
    static = kitti.read_static_frames(root / "lists" / "static_frames.txt")
    assert len(static) == WORLD.static_frames
    shots = plan_world(WORLD, root).shots
    for drive in (root / "lists" / "train_drives.txt").read_text().split():
        places = [shot.pose[:3, 3] for shot in shots if shot.image.is_relative_to(root / "kitti_raw" / drive)]
        still = {k for k in range(len(places) - 1) if np.allclose(places[k], places[k + 1], rtol=0, atol=1e-3)}
        assert len(places) == WORLD.frames_per_drive and still | {k + 1 for k in still} == {k for name, k in static if name == drive}


def test_odometry_sequences_have_frames_poses_and_a_test_path_longer_than_250_m(root):
    for name, test in (("00", False), ("09", True)):
        sequence = root / "kitti_odometry" / "sequences" / name
        poses = np.loadtxt(root / "kitti_odometry" / "poses" / f"{name}.txt").reshape(-1, 3, 4)
        images = sorted((sequence / "image_2").glob("*.png"))
        assert [path.name for path in images] == [f"{k:06d}.png" for k in range(len(poses))]
        np.testing.assert_array_equal(poses[0], np.eye(3, 4))
        np.testing.assert_allclose(poses[:, :, :3] @ poses[:, :, :3].transpose(0, 2, 1), np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-6)
        length = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1).sum()
        assert length > 250 if test else len(poses) == WORLD.odometry_frames
        calibration = kitti.read_calibration(sequence / "calib.txt")
        np.testing.assert_allclose(calibration["P2"].reshape(3, 4)[:, :3], kitti.intrinsics(root / "kitti_raw", formats.DATE))
        np.testing.assert_allclose(calibration["Tr"].reshape(3, 4), formats.LASER_TO_CAMERA[:3], atol=1e-9)
        if test:
            headings = np.degrees(np.unwrap(np.arctan2(poses[:, 0, 2], poses[:, 2, 2])))
            assert np.ptp(headings) > 45
            assert (poses[1:, 2, 3] > 0).all()


def test_make3d_photo_and_grid_show_the_same_view(root):
    photo = kitti.read_image(root / "make3d" / "Test134" / "img-mini-p-000t000.jpg")
    assert photo.shape == (*WORLD.make3d_size, 3)
    grid = loadmat(root / "make3d" / "Gridlaserdata" / "depth_sph_corr-mini-p-000t000.mat")["Position3DGrid"]
    assert grid.shape == (55, 305, 4)
    np.testing.assert_allclose(np.linalg.norm(grid[..., :3], axis=-1), grid[..., 3], rtol=1e-6)
    assert 1 < grid[..., 3].min() < 6
    assert grid[..., 3].max() <= formats.FARTHEST
    assert (grid[:8, :, 3] > 70).mean() > (grid[-8:, :, 3] > 70).mean() == 0


def test_grid_cells_divide_the_photo_evenly():
    matrix = grid_intrinsics(np.array([[100.0, 0, 52], [0, 100, 70], [0, 0, 1]]), (140, 105))
    for corner, cell in ((-0.5, -0.5), (104.5, 304.5)):  # the photo's edges are the grid's edges
        assert matrix[0, 0] * (corner - 52) / 100 + matrix[0, 2] == pytest.approx(cell)


def test_training_drives_show_the_turns_of_the_sequences_that_are_scored(tmp_path):
    """Of the default profile; a drive that shows one turn alone teaches PoseNet to know the street."""
    world = load_profile("miniature").world.model_dump() | {"train_drives": 8, "test_drives": 1, "make3d_images": 1}
    poses = {}
    for shot in plan_world(World(**world), tmp_path).shots:
        poses.setdefault(shot.image.parent, []).append(shot.pose)

    def yaw(path):
        steps = np.linalg.inv(poses[path][:-1]) @ np.array(poses[path][1:])
        return np.degrees(np.arctan2(steps[:, 0, 2], steps[:, 2, 2]))

    train = [yaw(path) for path in poses if path.parts[-3].endswith("_sync") and "_drive_00" in path.parts[-3]]
    scored = [yaw(path) for path in poses if path.parent.name in ("09", "10")]
    assert len(train) == 8 and len(scored) == 2
    assert np.mean([turns.std() for turns in train]) > 0.4
    assert np.percentile(np.abs(np.concatenate(train)), 95) >= np.percentile(np.abs(np.concatenate(scored)), 95)


GOLDEN = {
    "kitti_raw/2019_10_27/2019_10_27_drive_0001_sync/image_02/data/0000000000.png": (100.3159, 46.6250),
    "kitti_raw/2019_10_27/2019_10_27_drive_0101_sync/image_02/data/0000000000.png": (99.9789, 51.1496),
    "labels/2019_10_27_drive_0101_sync/0000000000.png": (4.1246, 4.4236),
    "make3d/Test134/img-mini-p-000t000.jpg": (120.3350, 65.0760),
}
"""Mean and standard deviation of pictures, as they were when numbers of such worlds were published."""


def test_the_world_is_still_the_one_that_the_published_numbers_are_of(least):
    for name, expected in GOLDEN.items():
        image = kitti.read_image(least / name)
        assert (image.mean(), image.std()) == pytest.approx(expected, abs=0.01), name
    assert np.load(least / "dense_depth/2019_10_27_drive_0101_sync/0000000000.npy").mean() == pytest.approx(21.9885, abs=1e-3)
    scan = np.fromfile(least / "kitti_raw/2019_10_27/2019_10_27_drive_0101_sync/velodyne_points/data/0000000000.bin", "<f4").reshape(-1, 4)
    assert len(scan) == 6047 and scan.mean(0) == pytest.approx([13.2925, 0.8576, -1.2287, 0.3209], abs=1e-3)


def test_several_processes_give_the_same_bytes_and_another_seed_other_streets_on_its_side_only(least, tmp_path):
    make(LEAST.model_copy(update={"test_seed": 7}), tmp_path / "other", processes=2)
    one, other = contents(least), contents(tmp_path / "other")
    assert one.keys() == other.keys()
    changed = {name for name in one if one[name] != other[name]}
    pictures = {name for name in one if name.endswith((".png", ".jpg", ".bin", ".npy", ".mat"))}
    assert {name for name in pictures if "_drive_01" in name or "make3d" in name} <= changed
    assert not {name for name in pictures if "_drive_00" in name} & changed


def test_a_world_that_is_there_is_not_made_again_and_another_one_is_replaced_or_stays_whole(least, tmp_path, monkeypatch, capsys):
    out = tmp_path / "w"
    shutil.copytree(least, out)
    (tmp_path / ".w.part" / "rest").mkdir(parents=True)  # of a killed run
    assert not make(LEAST, out) and "there already" in capsys.readouterr().out
    fewer = LEAST.model_copy(update={"make3d_images": 0})
    with monkeypatch.context() as patch, pytest.raises(ZeroDivisionError):
        patch.setattr(make_miniature, "write_shot", lambda _: 1 / 0)
        make(fewer, out)
    assert contents(out) == contents(least)
    with locked(tmp_path / ".w.lock"), pytest.raises(InputError, match="held by process"):
        make(fewer, out)
    assert make(fewer, out) and not list(out.rglob("*.mat"))
    assert json.loads((out / "world.json").read_text())["settings"]["make3d_images"] == 0
    assert {path.name for path in tmp_path.iterdir()} == {"w", ".w.lock"}


def test_folder_with_something_else_is_refused_and_kept(tmp_path):
    (tmp_path / "thesis.tex").touch()
    with pytest.raises(InputError, match="is no world"):
        make(LEAST, tmp_path)
    assert (tmp_path / "thesis.tex").exists()


def test_command_makes_a_world_and_answers_mistakes_with_one_line(tmp_path, refused):
    profile, out = tmp_path / "small.yaml", tmp_path / "w"
    call = ["--profile", str(profile), "--out", str(out)]
    profile.write_text(f"about: a test\nworld: {json.dumps(LEAST.model_dump(mode='json'))}\ndata: {{source: miniature}}\n")
    make_miniature.main(call)
    assert (out / "world.json").is_file()
    for world in ("world: {sized: 3}\ndata: {source: miniature}\n", "data: {source: kitti, train_drives: [a]}\n"):
        profile.write_text(f"about: a test\n{world}")
        refused(make_miniature.main, call)
