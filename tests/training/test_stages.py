"""What one optimisation step of either stage looks at, and what it moves."""

import contextlib

import pytest
import torch
from small_nets import averaged, output_of, with_heads
from small_stages import batch_of, stage_of
from torch import nn
from torch.utils._python_dispatch import TorchDispatchMode

from dualdepth import geometry
from dualdepth.device import compute_repeatably
from dualdepth.losses import total_loss
from dualdepth.networks import convolution
from dualdepth.networks.depth_nets import DualNet, LRNet
from dualdepth.networks.pose_net import PoseNet, make_pose_net
from dualdepth.training import stages


class SeenDepth(nn.Module):
    """Stands for a depth network and notes what it is given."""

    calls = 0

    def forward(self, image, scales=4):
        self.image, self.scales, self.calls = image, scales, self.calls + 1
        b, _, h, w = image.shape
        return output_of([image.mean(1, keepdim=True)[..., :: 2**s, :: 2**s] + 0.5 for s in range(scales)], image.expand(b, 3, h, w))


class SeenPose(PoseNet):
    """PoseNet that notes what it is given."""

    def forward(self, images):
        self.images = images
        return super().forward(images)


def seen_stage(low, depth_net=None, **changes):
    torch.manual_seed(0)
    return with_heads(stage_of(depth_net or SeenDepth(), SeenPose(), low, **changes))


@pytest.fixture(scope="module")
def batch():
    return batch_of(2, (96, 192))


@pytest.fixture
def asked(monkeypatch):
    """What the losses were asked for: images, matrix, disparities, poses, settings, features, a call each."""
    calls = []
    monkeypatch.setattr(stages, "total_loss", lambda *a: calls.append(a) or total_loss(*a))
    return calls


def test_lr_net_and_posenet_see_target_and_sources_averaged_3_by_3_and_depth_is_that_of_the_target(batch):
    stage = seen_stage(low=True)
    output = stage(batch)
    assert stage.depth_net.calls == 1
    assert torch.allclose(stage.depth_net.image.reshape(2, 3, 3, 32, 64), averaged(batch["images"]) / 255, atol=1e-6)
    assert torch.allclose(stage.pose_net.images, averaged(batch["images"]) / 255, atol=1e-6)
    assert torch.allclose(output.target, averaged(batch["images"][:, 0]) / 255, atol=1e-6)
    assert torch.allclose(output.disparity, output.target.mean(1, keepdim=True) + 0.5, atol=1e-6)
    assert torch.equal(output.features, output.target)


def test_without_the_feature_loss_lr_net_sees_targets_alone(batch):
    stage = seen_stage(low=True, feature=0)
    output = stage(batch)
    assert torch.allclose(stage.depth_net.image, output.target)
    assert output.losses.feature == 0


def test_at_high_resolution_the_target_alone_goes_through_the_depth_network_and_posenet_sees_averages(batch, asked):
    stage = seen_stage(low=False)
    output = stage(batch)
    images, matrix, disparities, poses, *_ = asked[0]
    assert torch.allclose(images, batch["images"].float() / 255)
    assert torch.equal(matrix, batch["intrinsics"])
    assert stage.depth_net.calls == 1
    assert torch.allclose(stage.depth_net.image, images[:, 0]) and torch.allclose(output.target, images[:, 0])
    assert torch.allclose(stage.pose_net.images, averaged(batch["images"]) / 255, atol=1e-6)
    assert torch.allclose(output.disparity, images[:, 0].mean(1, keepdim=True) + 0.5, atol=1e-6)
    assert [tuple(d.shape[-2:]) for d in disparities] == [(96 >> s, 192 >> s) for s in range(4)]
    assert poses.shape == (2, 2, 6)
    assert output.losses.synthesized.shape == (2, 3, 96, 192)


def test_frames_that_were_shrunk_first_are_not_shrunk_again_and_have_the_same_geometry(batch, asked):
    """Intrinsics given at full resolution are those of the low-resolution view times three."""
    seen_stage(low=True)(batch)
    assert torch.allclose(asked[0][1][0], torch.tensor([[40.0, 0, 31.5], [0, 40, 15.5], [0, 0, 1]]), atol=1e-5)
    stage = seen_stage(low=True, augment_first=False)
    output = stage(batch)
    assert torch.equal(asked[1][1], batch["intrinsics"])
    assert torch.allclose(output.target, batch["images"][:, 0].float() / 255)
    assert torch.allclose(stage.pose_net.images, batch["images"].float() / 255)


def test_at_high_resolution_there_is_no_feature_loss_whatever_its_weight(batch, asked):
    losses = seen_stage(low=False, photometric=2.0, smoothness=0.5, feature=100.0)(batch).losses
    assert losses.feature == 0
    assert asked[0][5] is None
    assert torch.allclose(losses.total, 2.0 * losses.photometric + 0.5 * losses.smoothness)
    assert losses.photometric > 0 and losses.smoothness > 0


@pytest.mark.parametrize("low", [True, False])
@pytest.mark.parametrize(
    "changes",
    [{"alpha": 0.3}, {"mean_disparity": 2.0}, {"beyond_paper_automask": True}, {"beyond_paper_full_resolution": True}, {"scales": 2}],
    ids=str,
)
def test_the_profiles_loss_is_taken(batch, changes, low):
    stage = seen_stage(low, **changes)
    assert stage(batch).losses.photometric != seen_stage(low)(batch).losses.photometric
    assert stage.depth_net.scales == changes.get("scales", 4)


@pytest.mark.parametrize("low", [True, False])
def test_the_networks_see_other_colours_alike_in_all_views_and_the_losses_the_frames(batch, asked, low):
    stage, grey = seen_stage(low), torch.full((2, 3, 3, 4, 4), 0.5)
    plain, stage.colour = stage(batch), 0.2
    stage.eval()(batch)
    coloured = stage.train()(batch)
    assert torch.equal(asked[0][0], asked[2][0]) and torch.equal(asked[1][3], asked[0][3]) and not torch.equal(asked[2][3], plain.poses)
    found = stages.recoloured(grey, 0.2)
    assert torch.equal(coloured.target, plain.target) and 0.4 <= found.min() < found.max() <= 0.6
    assert (found == found[:, :1, :1, :1, :1]).all() and found[0, 0, 0, 0, 0] != found[1, 0, 0, 0, 0]


def test_in_a_corridor_posenet_learns_alone(batch, asked):
    stage = seen_stage(low=True, feature=1.0)
    output = stage(batch, in_a_corridor=True)
    output.losses.total.backward()
    assert stage.depth_net.calls == 0 and asked[0][5] is None
    assert all(p.grad is not None for p in stage.pose_net.parameters())
    for given, expected in zip(asked[0][2], stages.corridor(asked[0][1], (32, 64), 4), strict=True):
        assert torch.equal(given, expected)
    assert set(output.statistics) == set(seen_stage(low=True)(batch).statistics)


@pytest.mark.parametrize("low", [True, False])
def test_losses_take_refined_poses_and_posenet_learns_them_alone(batch, asked, monkeypatch, low):
    given, better = [], torch.linspace(0, 0.02, 24).reshape(2, 2, 6)
    monkeypatch.setattr(stages, "refined", lambda *a: given.append(a) or better)
    stage = seen_stage(low, mean_disparity=2.0)
    output = stage(batch, refine=True)
    images, disparity, poses, matrix, mean = given[0]
    assert images.shape == (2, 3, 3, 32, 64) and disparity is asked[0][2][0] and torch.equal(asked[0][3], better) and mean == 2
    assert torch.allclose(matrix[0], torch.tensor([[40.0, 0, 31.5], [0, 40, 15.5], [0, 0, 1]]), atol=1e-5)
    assert torch.allclose(output.losses.total - total_loss(*asked[0]).total, (poses - better).abs().mean())
    output.losses.total.backward()
    assert all(p.grad is not None for p in stage.pose_net.parameters())


def test_a_corridor_is_as_near_as_its_road_and_its_walls():
    """A camera 1.5 above a road sees row v at depth 1.5 fy / (v − cy), and column u of a wall 8.25 aside at depth 8.25 fx / |u − cx|."""
    matrix = torch.tensor([[[50.0, 0, 150], [0, 60, 14], [0, 0, 1]]])
    finest, half = stages.corridor(matrix, (48, 320), scales=2)
    rows, columns = torch.arange(48)[:, None] - 14.0, (torch.arange(320)[None] - 150.0).abs()
    depth = torch.minimum(1.5 * 60 / rows.clamp(min=1e-9), 1.5 * 5.5 * 50 / columns.clamp(min=1e-9))
    farthest = 1.5 * 60 / 4  # four rows below the horizon, a twelfth of the height
    assert torch.allclose(finest[0, 0] * depth.clamp(max=farthest), torch.full((48, 320), farthest))
    assert finest[0, 0, 16, 150] == 1 and finest[0, 0, 5, 310] > 3 and finest[0, 0, 47, 310] > 8
    assert torch.allclose(half[0, 0], finest[0, 0].reshape(24, 2, 160, 2).mean((1, 3)))


@pytest.mark.parametrize("low", [True, False])
def test_the_log_has_losses_poses_and_disparities(batch, low):
    output = seen_stage(low)(batch)
    s = output.statistics
    assert s["loss"] == output.losses.total.detach()
    assert s["disparity_min"] == output.disparity.min()
    assert s["disparity_max"] == output.disparity.max()
    assert 0 < s["translation"] < 0.05
    assert 0 < s["rotation"] < 0.05
    assert s["feature_spread"] > 0.01
    assert not any(value.requires_grad for value in (*s.values(), *output[1:5]))
    assert "attention_scale" not in s


@pytest.mark.parametrize("low", [True, False])
def test_losses_are_float32_under_bfloat16(batch, low):
    stage = seen_stage(low)
    poses = stage(batch).poses
    stage.pose_net.forward = lambda images: poses  # PoseNet's own are rounded
    plain = stage(batch).losses
    with torch.autocast("cpu", torch.bfloat16):
        losses = stage(batch).losses
    assert all(torch.equal(a, b) for a, b in zip(losses, plain))


def test_what_hr_net_adds_is_anchored_where_frames_are_flat(batch):
    images, added = batch["images"].clone(), [torch.full((2, 1, 96 >> s, 192 >> s), 0.5 - s) for s in range(4)]
    images[:, 0] = 90  # the target; its sources are noise
    stage = seen_stage(low=False)
    plain, seen = stage(batch | {"images": images}).losses.total, stage.depth_net.forward
    stage.depth_net.forward = lambda *given: seen(*given)._replace(added=added)
    for stage.anchor in (0.0, 0.1):
        assert (stage(batch | {"images": images}).losses.total - plain).item() == pytest.approx(stage.anchor * 5 / 4, abs=1e-5)


@pytest.mark.parametrize("residual", [False, True])
def test_poses_are_refined_with_lr_nets_depth_while_hr_net_begins_from_nothing(encoder, asked, monkeypatch, residual):
    given, batch = [], batch_of(1, (192, 192))
    monkeypatch.setattr(stages, "refined", lambda images, disparity, poses, *_: given.append(disparity) or poses)
    stage = seen_stage(False, DualNet(LRNet(encoder), residual=residual)).eval()
    stage(batch, refine=True)
    lr_net = stage.depth_net.lr_net(averaged(batch["images"][:, 0]) / 255).disparities[0]
    assert torch.allclose(given[0], asked[0][2][0] if residual else lr_net, atol=1e-5) and given[0].std() > 0


@pytest.mark.parametrize("link", ["attention", "embedding", "direct"])
def test_the_log_has_the_scale_of_what_sa_attention_hands_over(dual_of, link):
    net, handed = dual_of(link), []
    if net.attention:
        net.attention.register_forward_hook(lambda _module, _given, found: handed.append(found))
    statistics = seen_stage(False, net)(batch_of(1, (192, 192))).statistics
    assert ("attention_scale" in statistics) == (link != "direct")
    if handed:
        assert torch.allclose(statistics["attention_scale"], handed[0].square().mean().sqrt())


UNORDERED = ("reflection_pad2d_backward", "grid_sampler_2d_backward", "_adaptive_avg_pool2d_backward", "cumsum", "put_")
"""Of torch's list of what has no deterministic algorithm on a GPU, what depth networks use. Of bilinear resizing and of borders that go on
(`replicate`) torch has one there."""


class Unordered(TorchDispatchMode):
    """Collects operations whose sums have no fixed order on a GPU; sampling's gradient has none for the image alone."""

    def __init__(self):
        super().__init__()
        self.found = set()

    def __torch_dispatch__(self, operation, types, args=(), kwargs=None):
        name = operation.name().removeprefix("aten::").partition(".")[0]
        if name in UNORDERED and (name != "grid_sampler_2d_backward" or args[-1][0]):
            self.found.add(name)
        return operation(*args, **(kwargs or {}))


@pytest.mark.slow
@pytest.mark.parametrize(("low", "beyond"), [(True, False), (False, False), (True, True)])
def test_on_a_gpu_a_step_is_the_same_and_its_gradients_add_up_in_a_fixed_order(low, beyond, encoder, monkeypatch):
    torch.manual_seed(0)
    batch = batch_of(2, (192, 288))
    net = LRNet(encoder) if low else DualNet(LRNet(encoder), residual=True)
    pose_net = make_pose_net("efficientnet_lite0" if beyond else None, False)
    stage = with_heads(stage_of(net, pose_net, low, feature=1.0)).eval()
    totals, slopes, found = [], [], []
    for device in ("cuda", "cpu"):
        for module in (convolution, geometry):
            monkeypatch.setattr(module, "GPU", device)
        with Unordered() as operations, deterministic():
            totals.append(stage(batch, refine=beyond).losses.total)
            slopes.append(torch.autograd.grad(totals[-1], [p for p in stage.parameters() if p.requires_grad], allow_unused=True))
        found.append(operations.found)
    assert found[0] == {"reflection_pad2d_backward", *["grid_sampler_2d_backward"] * low} and not found[1]
    torch.testing.assert_close(*totals)
    for one, other in zip(*slopes):
        if one is not None:
            torch.testing.assert_close(other, one, rtol=1e-2, atol=1e-4 * float(one.abs().max()) + 1e-7)


@contextlib.contextmanager
def deterministic():
    """As a training has it."""
    compute_repeatably()
    try:
        yield
    finally:
        compute_repeatably(False)
