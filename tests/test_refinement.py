"""Direct image alignment against motions that are known, since the target is made from the source by them."""

import pytest
import torch
from torch.nn import functional as F

from dualdepth import refinement
from dualdepth.geometry import pose_matrix, reproject, sample
from dualdepth.refinement import refined

SIZE = (48, 120)
MATRIX = torch.tensor([[70.0, 0, 58], [0, 75.0, 25], [0, 0, 1]]).expand(2, 3, 3)
MOTIONS = torch.tensor([[[0.05, -0.01, -0.2, 0.004, 0.02, -0.006]], [[-0.03, 0.02, 0.15, -0.01, -0.03, 0.005]]])  # 2 to 5 pixels


@pytest.fixture(scope="module")
def views():
    """Images (2, 2, 3, H, W), target and source, of smooth noise, and disparity (2, 1, H, W) of mean 1, of a road between hills."""
    draw = torch.Generator().manual_seed(0)
    source = F.interpolate(torch.rand(2, 3, 12, 30, generator=draw), SIZE, mode="bicubic").clamp(0, 1)
    disparity = F.interpolate(torch.rand(2, 1, 3, 6, generator=draw) + 0.2, SIZE, mode="bilinear")
    disparity /= disparity.mean(dim=(2, 3), keepdim=True)
    target = sample(source, reproject(disparity, pose_matrix(MOTIONS[:, 0]), MATRIX)[0])
    return torch.stack([target, source], 1), disparity


def off(poses):
    return (poses - MOTIONS).abs().max().item()


def test_the_motion_between_two_images_is_found_whatever_the_exposure(views):
    images, disparity = views
    begun = MOTIONS + 0.3 * MOTIONS.flip(0)
    darker = images * torch.tensor([1.0, 0.7]).view(1, 2, 1, 1, 1)
    for given in (images, darker):
        found = refined(given, disparity, begun.requires_grad_(), MATRIX)
        assert off(found) < 0.05 * off(begun) and not found.requires_grad


def test_each_source_has_its_own_motion(views):
    images, disparity = views
    twice = torch.cat([images, images[:, :1]], 1)  # the target is a source, too
    found = refined(twice, disparity, torch.cat([MOTIONS, 0.1 * MOTIONS], 1), MATRIX)
    assert off(found[:, :1]) < 3e-3 and found[:, 1].abs().max() < 3e-3


def test_a_pose_stays_where_no_better_one_is_found(views, monkeypatch):
    images, disparity = views
    behind = MOTIONS - torch.tensor([0, 0, 1e4, 0, 0, 0])  # nothing is seen
    for given, begun in ((torch.full_like(images, 0.5), MOTIONS), (images, behind)):
        assert torch.equal(refined(given, disparity, begun, MATRIX), begun)
    monkeypatch.setattr(refinement._Steps, "next", lambda self, transform: transform @ pose_matrix(MOTIONS[:, 0]))  # the wrong way
    assert torch.equal(refined(images, disparity, MOTIONS, MATRIX), MOTIONS)


def test_disparity_may_have_any_scale_and_translations_have_that_of_its_mean(views):
    images, disparity = views
    tenth = torch.tensor([0.1, 0.1, 0.1, 1, 1, 1])
    found = refined(images, disparity, 1.1 * MOTIONS, MATRIX)
    assert torch.allclose(refined(images, 7 * disparity, 1.1 * MOTIONS * tenth, MATRIX, 10.0), found * tenth, atol=1e-5)


def test_a_sharp_turn_is_found_from_nothing_at_the_papers_size():
    draw = torch.Generator().manual_seed(0)
    source = F.interpolate(torch.rand(1, 3, 16, 52, generator=draw), (128, 416), mode="bicubic").clamp(0, 1)
    disparity, matrix = torch.ones(1, 1, 128, 416), torch.tensor([[[241.0, 0, 208], [0, 241.0, 60], [0, 0, 1]]])
    turn = torch.tensor([[[0.0, 0, 0, 0, 0.057, 0]]])  # 3.3°
    target = sample(source, reproject(disparity, pose_matrix(turn[:, 0]), matrix)[0])
    found = refined(torch.stack([target, source], 1), disparity, torch.zeros(1, 1, 6), matrix)
    assert (found - turn).abs().max() < 2e-3
