"""What one optimisation step of stage 1 looks at."""

import pytest
import torch
from torch import nn

from dualdepth.losses import total_loss
from dualdepth.networks.decoder import DepthOutput
from dualdepth.profile import load_profile
from dualdepth.training import stages
from dualdepth.training.stages import Stage


class Seen(nn.Module):
    """Stands for LR-Net and notes what it is given."""

    def forward(self, image, scales=4):
        self.image, self.scales = image, scales
        b, _, h, w = image.shape
        return DepthOutput([image.mean(1, keepdim=True)[..., :: 2**s, :: 2**s] + 0.5 for s in range(scales)], image.expand(b, 3, h, w))


def stage_of(**changes):
    profile = load_profile("tiny")
    loss = profile.training.loss.model_copy(update={k: v for k, v in changes.items() if k != "augment_first"})
    augmentation = profile.training.augmentation.model_copy(update={"augment_first": changes.get("augment_first", True)})
    training = profile.training.model_copy(update={"loss": loss, "augmentation": augmentation})
    stage = Stage(profile.model_copy(update={"training": training}))
    stage.depth_net = Seen()
    return stage


@pytest.fixture(scope="module")
def batch():
    rng = torch.Generator().manual_seed(0)
    images = torch.randint(0, 256, (2, 3, 3, 96, 192), generator=rng, dtype=torch.uint8)
    return {"images": images, "intrinsics": torch.tensor([[120.0, 0, 95.5], [0, 120, 47.5], [0, 0, 1]]).expand(2, 3, 3), "name": ["a", "b"]}


def test_lr_net_sees_target_and_sources_averaged_3_by_3(batch):
    stage = stage_of()
    output = stage(batch)
    expected = batch["images"].float().reshape(2, 3, 3, 32, 3, 64, 3).mean((4, 6)) / 255
    assert torch.allclose(stage.depth_net.image.reshape(2, 3, 3, 32, 64), expected, atol=1e-6)
    assert torch.allclose(output.target, expected[:, 0], atol=1e-6)


def test_depth_is_that_of_the_target(batch):
    output = stage_of()(batch)
    assert torch.allclose(output.disparity, output.target.mean(1, keepdim=True) + 0.5, atol=1e-6)


def test_without_the_feature_loss_only_targets_are_looked_at(batch):
    stage = stage_of(feature=0)
    output = stage(batch)
    assert torch.allclose(stage.depth_net.image, output.target)
    assert output.losses.feature == 0


def test_frames_that_were_shrunk_first_are_not_shrunk_again(batch):
    output = stage_of(augment_first=False)(batch)
    assert torch.allclose(output.target, batch["images"][:, 0].float() / 255)


def test_both_orders_mean_the_same_geometry(batch, monkeypatch):
    """Intrinsics given at full resolution are those of the low-resolution view times three."""
    asked = []
    monkeypatch.setattr(stages, "total_loss", lambda images, matrix, *a, **k: asked.append(matrix) or total_loss(images, matrix, *a, **k))
    stage_of()(batch)
    assert torch.allclose(asked[0][0], torch.tensor([[40.0, 0, 31.5], [0, 40, 15.5], [0, 0, 1]]), atol=1e-5)
    stage_of(augment_first=False)(batch)
    assert torch.equal(asked[1], batch["intrinsics"])


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


def test_the_number_of_scales_is_the_profiles(batch):
    stage = stage_of(scales=2)
    stage(batch)
    assert stage.depth_net.scales == 2
