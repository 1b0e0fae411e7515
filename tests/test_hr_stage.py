"""What one optimisation step of stage 2 looks at, and what it moves."""

import pytest
import torch
from torch import nn

from dualdepth.losses import total_loss
from dualdepth.networks.decoder import DepthOutput
from dualdepth.networks.depth_nets import DualNet, LRNet
from dualdepth.networks.pose_net import PoseNet
from dualdepth.profile import load_profile
from dualdepth.training import stages
from dualdepth.training.stages import Stage


class SeenDepth(nn.Module):
    """Stands for a depth network and notes what it is given."""

    calls = 0

    def forward(self, image, scales=4):
        self.image, self.scales, self.calls = image, scales, self.calls + 1
        b, _, h, w = image.shape
        return DepthOutput([image.mean(1, keepdim=True)[..., :: 2**s, :: 2**s] + 0.5 for s in range(scales)], image.expand(b, 3, h, w))


class SeenPose(PoseNet):
    """PoseNet that notes what it is given."""

    def forward(self, images):
        self.images = images
        return super().forward(images)


def stage_of(depth_net=None, channels_last=True, **loss):
    profile = load_profile("tiny")
    training = profile.training.model_copy(update={"loss": profile.training.loss.model_copy(update=loss), "channels_last": channels_last})
    torch.manual_seed(0)
    return Stage(profile.model_copy(update={"training": training}), depth_net or SeenDepth(), SeenPose())


def batch_of(items=2, size=(96, 192)):
    rng = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (items, 3, 3, *size), generator=rng, dtype=torch.uint8)
    matrix = torch.tensor([[120.0, 0, 95.5], [0, 120, 47.5], [0, 0, 1]])
    return {"images": images, "intrinsics": matrix.expand(items, 3, 3), "name": ["a", "b"][:items]}


@pytest.fixture(scope="module")
def batch():
    return batch_of()


@pytest.fixture(scope="module")
def dual_of(encoder):
    """A small dual network in training mode."""

    def make(link):
        torch.manual_seed(0)
        return DualNet(LRNet(encoder), link).train()

    return make


@pytest.fixture
def asked(monkeypatch):
    """What the losses were asked for: positional arguments and the others, a call each."""
    calls = []
    monkeypatch.setattr(stages, "total_loss", lambda *a, **k: calls.append((a, k)) or total_loss(*a, **k))
    return calls


def test_only_the_target_goes_through_the_depth_network_at_full_resolution(batch):
    stage = stage_of()
    output = stage(batch)
    expected = batch["images"][:, 0].float() / 255
    assert stage.depth_net.calls == 1
    assert torch.allclose(stage.depth_net.image, expected)
    assert torch.allclose(output.target, expected)
    assert torch.allclose(output.disparity, expected.mean(1, keepdim=True) + 0.5, atol=1e-6)
    assert not output.disparity.requires_grad


def test_posenet_sees_target_and_sources_averaged_3_by_3(batch):
    stage = stage_of()
    stage(batch)
    expected = batch["images"].float().reshape(2, 3, 3, 32, 3, 64, 3).mean((4, 6)) / 255
    assert torch.allclose(stage.pose_net.images, expected, atol=1e-6)


def test_losses_are_those_of_full_resolution_with_the_batchs_own_intrinsics(batch, asked):
    stage = stage_of()
    output = stage(batch)
    (images, matrix, disparities, poses), _ = asked[0]
    assert torch.allclose(images, batch["images"].float() / 255)
    assert torch.equal(matrix, batch["intrinsics"])
    assert [tuple(d.shape[-2:]) for d in disparities] == [(96 >> s, 192 >> s) for s in range(4)]
    assert poses.shape == (2, 2, 6)
    assert output.losses.synthesized.shape == (2, 3, 96, 192)


def test_there_is_no_feature_loss_whatever_its_weight(batch, asked):
    stage = stage_of(photometric=2.0, smoothness=0.5, feature=100.0)
    losses = stage(batch).losses
    assert losses.feature == 0
    assert asked[0][1].get("features") is None
    assert torch.allclose(losses.total, 2.0 * losses.photometric + 0.5 * losses.smoothness)
    assert losses.photometric > 0
    assert losses.smoothness > 0


@pytest.mark.parametrize("changes", [{"alpha": 0.3}, {"mean_disparity": 2.0}, {"beyond_paper_automask": True}], ids=str)
def test_the_profiles_loss_is_taken(batch, changes):
    assert stage_of(**changes)(batch).losses.photometric != stage_of()(batch).losses.photometric


def test_the_number_of_scales_is_the_profiles(batch):
    stage = stage_of(scales=2)
    stage(batch)
    assert stage.depth_net.scales == 2


@pytest.mark.parametrize("channels_last", [True, False])
def test_the_memory_layout_is_the_profiles(batch, channels_last):
    stage = stage_of(channels_last=channels_last)
    stage(batch)
    assert stage.depth_net.image.is_contiguous(memory_format=torch.channels_last) == channels_last


def test_the_log_has_losses_poses_and_disparities(batch):
    output = stage_of()(batch)
    s = output.statistics
    assert s["loss"] == output.losses.total.detach()
    assert s["disparity_min"] == output.disparity.min()
    assert s["disparity_max"] == output.disparity.max()
    assert 0 < s["translation"] < 0.05
    assert 0 < s["rotation"] < 0.05
    assert s["feature_spread"] > 0.01
    assert not any(value.requires_grad for value in s.values())


def test_losses_are_float32_under_bfloat16(batch):
    stage = stage_of()
    poses = stage(batch).poses
    stage.pose_net.forward = lambda images: poses  # PoseNet's own are rounded
    plain = stage(batch).losses
    with torch.autocast("cpu", torch.bfloat16):
        losses = stage(batch).losses
    assert all(torch.equal(a, b) for a, b in zip(losses, plain))


@pytest.mark.parametrize("link", ["attention", "embedding"])
def test_the_log_has_the_scale_of_what_sa_attention_hands_over(dual_of, link):
    net, handed = dual_of(link), []
    net.attention.register_forward_hook(lambda _module, _given, found: handed.append(found))
    statistics = stage_of(net)(batch_of(1, (192, 192))).statistics
    assert torch.allclose(statistics["attention_scale"], handed[0].square().mean().sqrt())
    assert statistics.keys() == stage_of()(batch_of()).statistics.keys() | {"attention_scale"}


def test_without_sa_attention_the_log_has_no_scale_of_it(batch, dual_of):
    assert "attention_scale" not in stage_of(dual_of("direct"))(batch_of(1, (192, 192))).statistics
    assert "attention_scale" not in stage_of()(batch).statistics


def test_a_step_moves_hr_net_sa_attention_and_posenet_but_not_lr_net(dual_of):
    stage = stage_of(dual_of("attention")).train()
    before = {name: value.clone() for name, value in stage.state_dict().items()}
    optimizer = torch.optim.Adam(stage.parameters(), lr=1e-3)
    stage(batch_of(1, (192, 192))).losses.total.backward()
    optimizer.step()
    same = {name for name, value in stage.state_dict().items() if torch.equal(value, before[name])}
    assert same == {f"depth_net.lr_net.{name}" for name in stage.depth_net.lr_net.state_dict()}
    assert {name.split(".")[1] for name in before if name.startswith("depth_net.")} == {"lr_net", "attention", "hr_net"}
