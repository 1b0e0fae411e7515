"""The world's geometry is exact: closed forms, reprojection of one frame into the next, and the laser against dense depth."""

import cv2
import numpy as np
import pytest

from data_scripts.miniature import formats, solids
from data_scripts.miniature.cast import FIRST, GROUND, SKY, cast
from data_scripts.miniature.drives import drive
from data_scripts.miniature.render import camera_rays, laser_scan, render, render_geometry
from data_scripts.miniature.scene import build_scene
from data_scripts.miniature.street import Place, Plan, build_street
from dualdepth.data.kitti import intrinsics, read_calibration

SIZE = (208, 656)
K = formats.intrinsics(SIZE)
PLAN = Plan((5, 5), length=60.0, movers=3)


@pytest.fixture(scope="module")
def scene():
    return build_scene(PLAN)


@pytest.fixture(scope="module")
def poses(scene):
    return drive(PLAN, scene.street, spacing=1.0, frames=50).poses


@pytest.fixture(scope="module")
def views(scene, poses):
    """Two consecutive frames."""
    return [render(scene, poses[k], K, SIZE, supersample=2, time=0.1 * k) for k in (10, 11)]


def level_camera():
    pose = np.eye(4)
    pose[1, 3] = -1.65
    return pose


def test_ground_depth_is_height_times_focal_length_over_rows_below_the_horizon():
    rays = camera_rays(level_camera(), K, SIZE)
    hits = cast([solids.block(Place(np.array([0, -50.0]), 0.0), (1, 1, 1), "plain", 2, (0, 0, 0), 0.0)], rays)
    v = np.arange(SIZE[0])
    below = v > K[1, 2]
    np.testing.assert_allclose(1 / hits.nearness[below, 300], 1.65 * K[1, 1] / (v[below] - K[1, 2]), rtol=1e-5)
    assert (hits.index[below] == GROUND).all()
    assert (hits.index[~below] == SKY).all()


def test_box_cylinder_and_sphere_are_met_where_they_stand():
    box = solids.block(Place(np.array([0.0, 20.0]), 0.0), (4.0, 3.0, 3.0), "plain", solids.BUILDING, (0, 0, 0), 0.0)
    post = solids.cylinder(np.array([0.0, 12.0]), 0.1, 3.0, "metal", solids.POLE, (0, 0, 0), 0.0)
    ball = solids.ellipsoid([0, -1.65, 30], [2, 2, 2], "leaves", solids.VEGETATION, (0, 0, 0), 0.0)
    middle = np.array([[0.58 * 656, 0, 300], [0, 0.58 * 656, 100], [0, 0, 1]])
    rays = camera_rays(level_camera(), middle, SIZE)
    for shape, depth in ((box, 18.0), (post, 11.9), (ball, 28.0)):
        hits = cast([shape], rays)
        assert 1 / hits.nearness[100, 300] == pytest.approx(depth, rel=1e-5)
        assert hits.index[100, 300] >= FIRST
    assert (cast([box], rays).index >= FIRST).any(0).sum() == pytest.approx(3.0 * middle[0, 0] / 18, abs=1)
    assert (cast([post], rays).index[100] >= FIRST).sum() == pytest.approx(0.2 * middle[0, 0] / 12, abs=1)
    top = np.flatnonzero((cast([post], rays).index >= FIRST).any(1)).min()
    assert top == pytest.approx(100 - 1.35 * middle[1, 1] / 11.9, abs=1)


def warp(target, source, target_pose, source_pose):
    """The source's image as seen from the target, and where the comparison is fair; written for this test."""
    v, u = np.mgrid[: SIZE[0], : SIZE[1]].astype(float)
    points = np.stack([(u - K[0, 2]) / K[0, 0], (v - K[1, 2]) / K[1, 1], np.ones(SIZE)]).reshape(3, -1) * target.depth.ravel()
    motion = np.linalg.inv(source_pose) @ target_pose
    x, y, z = motion[:3, :3] @ points + motion[:3, 3:]
    with np.errstate(divide="ignore", invalid="ignore"):
        column = (K[0, 0] * x / z + K[0, 2]).reshape(SIZE).astype(np.float32)
        row = (K[1, 1] * y / z + K[1, 2]).reshape(SIZE).astype(np.float32)
    z = z.reshape(SIZE)
    inside = (target.depth > 0) & (z > 0.5) & (column > 0) & (column < SIZE[1] - 1) & (row > 0) & (row < SIZE[0] - 1)
    seen = cv2.remap(source.depth, column, row, cv2.INTER_NEAREST)
    moving = cv2.remap(source.moving.astype(np.uint8), column, row, cv2.INTER_NEAREST) > 0
    fair = inside & ~target.moving & ~moving & (abs(seen - z) < 0.03 * z + 0.05)
    return cv2.remap(source.image, column, row, cv2.INTER_LINEAR), fair, inside


def test_reprojection_with_true_depth_and_pose_gives_the_next_frame_and_with_others_it_does_not(views, poses):
    target, source = views

    def error(target, first, second, fair_alone=False):
        warped, fair, inside = warp(target, source, poses[first], poses[second])
        return abs(warped.astype(float) - target.image).mean(-1)[fair if fair_alone else inside]

    fair, right = error(target, 10, 11, fair_alone=True), error(target, 10, 11)
    assert fair.size > 0.4 * target.depth.size and np.median(fair) < 2.0 and fair.mean() < 5.0
    deeper, inverted = error(target._replace(depth=target.depth * 1.1), 10, 11), error(target, 11, 10)
    assert np.median(deeper) > 1.2 * np.median(right) and deeper.mean() > 1.2 * right.mean()
    assert np.median(inverted) > 2 * np.median(right)


def test_moving_cars_move_and_break_the_static_world(scene, poses):
    before, after = (render_geometry(scene, poses[10], K, SIZE, time) for time in (1.0, 1.5))
    assert before[2].any()
    changed = before[0] != after[0]
    assert changed.any()
    assert not (changed & ~before[2] & ~after[2]).any()


def test_laser_points_agree_with_dense_depth_through_the_calibration_files(tmp_path, scene, poses):
    (tmp_path / formats.DATE).mkdir()
    for name, text in formats.calibration_texts(SIZE).items():
        (tmp_path / formats.DATE / name).write_text(text)
    matrix = intrinsics(tmp_path, formats.DATE)
    np.testing.assert_allclose(matrix, K, atol=1e-6)
    velo = read_calibration(tmp_path / formats.DATE / "calib_velo_to_cam.txt")
    rectify = read_calibration(tmp_path / formats.DATE / "calib_cam_to_cam.txt")["R_rect_00"].reshape(3, 3)
    for k in (5, 30):
        scan = laser_scan(scene, poses[k], 0.0, azimuth_step=0.35, seed=(1, k))
        depth = render_geometry(scene, poses[k], K, SIZE, 0.0)[0]
        x, y, z = matrix @ rectify @ (velo["R"].reshape(3, 3) @ scan[:, :3].T.astype(float) + velo["T"][:, None])
        u, v = np.round(x / z).astype(int), np.round(y / z).astype(int)
        seen = (u >= 1) & (u < SIZE[1] - 1) & (v >= 1) & (v < SIZE[0] - 1)
        assert seen.sum() > 4000
        around = np.stack([depth[v[seen] + i, u[seen] + j] for i in (-1, 0, 1) for j in (-1, 0, 1)])
        error = (abs(around - z[seen]) / z[seen]).min(0)
        assert (error < 0.03).mean() > 0.96
        assert np.median(abs(around[4] - z[seen]) / z[seen]) < 0.01


def test_street_coordinates_invert_places():
    street = build_street(Plan((2,), length=120.0, bend=0.85, wavelength=210.0))
    rng = np.random.default_rng(0)
    s, d = rng.uniform(0, 120, 200), rng.uniform(-12, 12, 200)
    points, _ = street.place(s, d)
    again = street.coordinates(points[:, 0], points[:, 1])
    np.testing.assert_allclose(again, [s, d], atol=0.15)
