"""Ground truth from laser scans: equal to a slow reference, quirks included."""

from collections import Counter

import cv2
import numpy as np
import pytest

from dualdepth.data import lidar
from dualdepth.data.kitti import Frame, image_path, read_frame_list, read_image, velodyne_path

FRAME = Frame("2011_09_26/2011_09_26_drive_0001_sync", 3)
PROJECTION = np.array([[0.0, -40, 0, 0], [0, 0, -40, 0], [1, 0, 0, -0.27]]) + np.array([[30.0], [20], [0]]) * [1, 0, 0, -0.27]


def slow_depth(scan, projection, size, camera_z=False):
    """docs/protocols.md, "Depth on the Eigen split", step by step, one point and one cell at a time."""
    height, width = size
    points = scan[scan[:, 0] >= 0].astype(np.float64)
    points[:, 3] = 1
    projected = np.dot(projection, points.T).T
    with np.errstate(divide="ignore", invalid="ignore"):
        pixels = np.round(projected[:, :2] / projected[:, 2:]) - 1
    depth, kept = np.zeros(size), []
    for (column, row), z, point in zip(pixels.tolist(), projected[:, 2], points):
        if 0 <= column < width and 0 <= row < height:
            kept.append((int(row), int(column), z if camera_z else point[0]))
            depth[int(row), int(column)] = kept[-1][2]
    index = [row * (width - 1) + column - 1 for row, column, _ in kept]
    groups: dict[int, list] = {}
    for i, item in zip(index, kept):
        groups.setdefault(i, []).append(item)
    for i in [i for i, hits in Counter(index).items() if hits > 1]:
        row, column, _ = groups[i][0]
        depth[row, column] = min(value for _, _, value in groups[i])
    depth[depth < 0] = 0
    return depth.astype(np.float32)


def random_scan(seed, count=4000):
    rng = np.random.default_rng(seed)
    scan = rng.uniform(-1, 1, (count, 4)) * [30, 12, 6, 1]
    scan[:40, 0] = rng.uniform(0, 0.3, 40)  # between laser and camera: behind the image plane
    scan[40] = [0.27, 1, 1, 0]
    return scan.astype(np.float32)


@pytest.mark.parametrize("camera_z", [False, True])
@pytest.mark.parametrize("seed", range(4))
def test_random_scans_equal_the_reference_bit_for_bit(seed, camera_z):
    scan = random_scan(seed)
    fast = lidar.depth_from_scan(scan, PROJECTION, (40, 60), camera_z=camera_z)
    assert np.count_nonzero(fast) > 100
    np.testing.assert_array_equal(fast, slow_depth(scan, PROJECTION, (40, 60), camera_z))


def test_real_scans_equal_the_reference_bit_for_bit(real):
    frames, root = read_frame_list(real("splits/sample_val.txt")), real("kitti_raw")
    projection = lidar.velodyne_projection(root, frames[0].date)
    for number, frame in enumerate(frames):
        camera_z, size = number % 4 == 0, read_image(image_path(root, frame)).shape[:2]
        depth = lidar.ground_truth(root, frame, camera_z=camera_z)
        scan = lidar.read_scan(velodyne_path(root, frame))
        assert depth.dtype == np.float32 and depth.any()
        np.testing.assert_array_equal(depth, slow_depth(scan, projection, size, camera_z))


def test_laser_forward_is_the_default_and_differs_from_camera_z_by_the_lever_arm():
    scan = np.array([[10, 0, 0, 0.5]], np.float32)
    assert lidar.depth_from_scan(scan, PROJECTION, (40, 60)).max() == 10
    assert lidar.depth_from_scan(scan, PROJECTION, (40, 60), camera_z=True).max() == pytest.approx(9.73, abs=1e-5)


def test_pixels_round_half_to_even_and_lose_one():
    projection = np.array([[0, -1.0, 0, 0], [0, 0, -1.0, 0], [1, 0, 0, 0]])
    scan = np.array([[1, -2.5, -4.5, 0], [1, -3.5, -5.5, 0]], np.float32)  # (u, v) = (2.5, 4.5), (3.5, 5.5)
    rows, columns = np.nonzero(lidar.depth_from_scan(scan, projection, (10, 10)))
    assert list(zip(rows, columns)) == [(3, 1), (5, 3)]


def test_map_has_the_images_size_or_else_that_of_the_calibration(kitti_factory, write_scan):
    root = kitti_factory({FRAME.drive: [3]})
    write_scan(root, FRAME.drive, 3)
    expected = [[104, -220, 0, -0.27 * 104], [104, 0, -220, -0.27 * 104], [1, 0, 0, -0.27]]
    np.testing.assert_allclose(lidar.velodyne_projection(root, FRAME.date), expected, atol=1e-12)
    cv2.imwrite(str(image_path(root, FRAME)), np.zeros((48, 64, 3), np.uint8))
    assert lidar.ground_truth(root, FRAME).shape == (48, 64)
    image_path(root, FRAME).unlink()
    assert lidar.ground_truth(root, FRAME).shape == (208, 208)


@pytest.mark.parametrize("folder", ["train/2011_09_26_drive_0001_sync", "val/2011_09_26_drive_0001_sync", FRAME.drive])
def test_improved_ground_truth_is_the_png_over_256(tmp_path, folder):
    path = tmp_path / folder / "proj_depth" / "groundtruth" / "image_02" / "0000000003.png"
    path.parent.mkdir(parents=True)
    cv2.imwrite(str(path), np.array([[0, 256], [384, 65535]], np.uint16))
    depth = lidar.improved_ground_truth(tmp_path, FRAME)
    assert depth.dtype == np.float32
    np.testing.assert_array_equal(depth, [[0, 1], [1.5, 65535 / 256]])
