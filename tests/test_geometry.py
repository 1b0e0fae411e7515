"""View synthesis against closed forms and a slow NumPy reading of equation 1; its gradients are checked with those of the losses."""

import numpy as np
import pytest
import torch
from slow_losses import slow_warp

from dualdepth import geometry
from dualdepth.geometry import gathered, inverse_pose, pose_matrix, reproject, resize_intrinsics, rotation_matrix, sample

KITTI = torch.tensor([[721.5, 0.0, 609.6], [0.0, 721.5, 172.9], [0.0, 0.0, 1.0]])


def camera(height, width, focal=None):
    f = focal or 0.6 * width
    return torch.tensor([[f, 0.0, 0.47 * width], [0.0, 1.1 * f, 0.53 * height], [0.0, 0.0, 1.0]])[None]


def disparities(height, width, seed=0):
    return 0.02 + torch.rand(1, 1, height, width, generator=torch.Generator().manual_seed(seed))


def pose(*numbers):
    return pose_matrix(torch.tensor([numbers], dtype=torch.float32))


def slow_rotation(x, y, z):
    rx = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    ry = np.array([[np.cos(y), 0, np.sin(y)], [0, 1, 0], [-np.sin(y), 0, np.cos(y)]])
    rz = np.array([[np.cos(z), -np.sin(z), 0], [np.sin(z), np.cos(z), 0], [0, 0, 1]])
    return rx @ ry @ rz


@pytest.mark.parametrize(("height", "width"), [(2, 3), (7, 13), (12, 39), (16, 96), (3, 1248)])
def test_warp_with_the_identity_pose_gives_the_image(height, width):
    image = torch.rand(1, 3, height, width, generator=torch.Generator().manual_seed(width))
    pixel, valid = reproject(disparities(height, width), pose(0, 0, 0, 0, 0, 0), camera(height, width))
    assert valid.all()
    # float32 knows pixel 1248 to about 1e-4
    assert torch.allclose(sample(image, pixel), image, atol=5e-4)


def test_points_behind_the_source_camera_are_invalid_and_finite():
    depth = torch.full((1, 1, 8, 16), 2.0)
    depth[..., 8:] = 50.0
    pixel, valid = reproject(1 / depth, pose(0, 0, -10, 0, 0, 0), camera(8, 16))
    assert not valid[..., :8].any()  # 8 m behind the camera; their mirrored projections would lie inside the image
    assert valid[0, 0, 4, 8]
    assert pixel.isfinite().all()
    # on the optical axis even a point behind the camera projects into the image
    k = torch.tensor([[[10.0, 0, 0], [0, 10, 0], [0, 0, 1]]])
    ahead, behind = (reproject(torch.ones(1, 1, 4, 4), pose(0, 0, z, 0, 0, 0), k)[1][0, 0, 0, 0] for z in (-0.5, -3))
    assert ahead and not behind


@pytest.mark.parametrize(("shift", "left"), [(0.4, 40), (0.6, 39), (3.0, 37), (-3.0, 37), (39.6, 0), (100.0, 0)])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_pixel_is_valid_while_it_lies_on_the_source_image(shift, left, axis):
    size = (6, 40) if axis == 0 else (40, 6)
    k, move = camera(*size), [0.0] * 6
    move[axis] = shift / k[0, axis, axis]
    _, valid = reproject(torch.ones(1, 1, *size), pose(*move), k)
    assert valid.all(dim=2 + axis).sum() == valid.any(dim=2 + axis).sum() == left


def test_the_rotation_is_rx_times_ry_times_rz():
    rng = np.random.default_rng(0)
    for angles in rng.uniform(-3, 3, (8, 3)):
        assert np.allclose(rotation_matrix(torch.tensor(angles)).numpy(), slow_rotation(*angles), atol=1e-12)
        nearer = 0.5 * torch.tensor([*rng.normal(size=3), *angles])  # turns of less than a right angle
        assert torch.allclose(pose_matrix(inverse_pose(nearer)) @ pose_matrix(nearer), torch.eye(4, dtype=torch.float64))
    # angles are clipped to half a turn
    assert torch.allclose(rotation_matrix(torch.tensor([0.0, 9.0, 0.0])), rotation_matrix(torch.tensor([0.0, torch.pi, 0.0])))


def test_a_pose_holds_the_translation_first_and_maps_target_points_to_source_points():
    poses = torch.rand(2, 3, 6, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    poses[1, 2] = torch.tensor([1.0, 2, 3, 0.1, 0.2, 0.3])
    matrices = pose_matrix(poses)
    point = np.array([0.5, -1, 7])
    assert matrices.shape == (2, 3, 4, 4)  # each source of a batch keeps its place
    assert np.allclose(matrices[1, 2].numpy() @ [*point, 1], [*(slow_rotation(0.1, 0.2, 0.3) @ point + [1, 2, 3]), 1], atol=1e-12)


def test_the_warp_equals_a_slow_reading_of_equation_1_and_of_bilinear_sampling(monkeypatch):
    grid = geometry.pixel_grid
    monkeypatch.setattr(geometry, "pixel_grid", lambda *arguments: grid(*arguments).double())
    k, disparity = camera(5, 9).double(), disparities(5, 9).double()
    numbers = torch.tensor([[0.3, -0.2, 0.4, 0.05, -0.1, 0.07]], dtype=torch.float64)
    image = torch.rand(1, 2, 5, 9, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    pixel, valid = reproject(disparity, pose_matrix(numbers), k)
    expected, seen = slow_warp(image[0].numpy(), disparity[0, 0].numpy(), numbers[0].numpy(), k[0].numpy())
    assert valid[0, 0].tolist() == seen.tolist() and 0.5 < seen.mean() < 0.95  # beyond the border, its value
    assert np.allclose(sample(image, pixel)[0].numpy(), expected, atol=1e-6)


def test_items_of_a_batch_use_their_own_pose_depth_and_intrinsics():
    disparity = torch.cat([disparities(6, 10, seed) for seed in range(3)])
    transforms = pose_matrix(0.1 * torch.rand(3, 6, generator=torch.Generator().manual_seed(1)))
    k = torch.cat([camera(6, 10, focal) for focal in (5.0, 8.0, 11.0)])
    together, _ = reproject(disparity, transforms, k)
    for i in range(3):
        alone, _ = reproject(disparity[i : i + 1], transforms[i : i + 1], k[i : i + 1])
        assert torch.allclose(together[i : i + 1], alone, atol=1e-5)


def test_an_infinitely_far_point_projects_to_its_vanishing_point():
    k = camera(6, 40)
    pixel, valid = reproject(torch.zeros(1, 1, 6, 40), pose(1, 2, 3, 0, 0, 0), k)
    assert valid.all()
    assert torch.allclose(pixel[0, ..., 0], torch.arange(40.0).expand(6, 40), atol=1e-4)


@pytest.mark.parametrize(("scale_x", "scale_y"), [(1 / 3, 1 / 3), (0.5, 0.25), (1.01, 1.13)])
def test_resized_intrinsics_project_a_point_to_the_place_the_resizing_moves_it(scale_x, scale_y):
    point = torch.tensor([2.0, -1.0, 9.0])
    given = KITTI.clone()
    before, after = KITTI @ point, resize_intrinsics(given, scale_x, scale_y) @ point
    assert torch.equal(given, KITTI)
    u, v = before[:2] / before[2]
    # the left edge of the image, at −0.5, stays at −0.5
    assert torch.allclose(after[:2] / after[2], torch.stack([(u + 0.5) * scale_x - 0.5, (v + 0.5) * scale_y - 0.5]), atol=1e-3)


def test_gradients_stay_finite_where_points_pass_through_the_camera_plane():
    disparity = (0.5 * torch.rand(1, 1, 6, 8, generator=torch.Generator().manual_seed(3))).requires_grad_()
    numbers = torch.tensor([[0.1, 0.2, -4.0, 0.0, 0.0, 0.0]], requires_grad=True)
    pixel, valid = reproject(disparity, pose_matrix(numbers), camera(6, 8))
    assert valid.any()
    assert not valid.all()
    sample(torch.rand(1, 3, 6, 8), pixel).sum().backward()
    assert disparity.grad.isfinite().all()
    assert numbers.grad.isfinite().all()


@pytest.mark.parametrize("bad", [torch.nan, torch.inf, -torch.inf, 1e30])
def test_coordinates_that_are_no_numbers_are_sampled_and_derived_without_harm(bad):
    """torch's own backward ends the process at NaN, which a pose that is not finite makes."""
    image = torch.rand(2, 3, 64, 64, requires_grad=True)
    pixel = torch.full((2, 64, 64, 2), 5.0)
    pixel[1] = bad
    pixel.requires_grad_()
    sample(image, pixel).sum().backward()
    assert pixel.grad.isfinite().all() and image.grad.isfinite().all()
    pixel, valid = reproject(disparities(8, 12), pose(bad, 0, 0, 0, 0, 0), camera(8, 12))
    assert not valid.any() or abs(bad) == 1e30


def test_a_gpus_samples_of_features_are_torchs_with_both_gradients():
    draw = torch.Generator().manual_seed(0)
    image = torch.rand(2, 3, 5, 8, generator=draw, requires_grad=True)
    pixel = (torch.rand(2, 4, 6, 2, generator=draw) * torch.tensor([12.0, 9.0]) - 2.0).requires_grad_()  # some outside
    found, expected = gathered(image, pixel), sample(image, pixel)
    torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-5)
    weights = torch.rand(expected.shape, generator=draw)
    slopes = [torch.autograd.grad((values * weights).sum(), [image, pixel]) for values in (found, expected)]
    torch.testing.assert_close(*slopes, rtol=1e-3, atol=1e-4)
