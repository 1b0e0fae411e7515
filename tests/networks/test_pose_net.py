"""PoseNet is that of Zhou et al. 2017."""

import pytest
import torch
from torch import nn

from dualdepth.geometry import pose_matrix
from dualdepth.networks.encoders import make_encoder
from dualdepth.networks.pose_net import EncoderPoseNet, PoseNet


@pytest.fixture
def net():
    """As after some steps; its last layer begins at zero."""
    torch.manual_seed(0)
    net = PoseNet()
    nn.init.xavier_uniform_(net.layers[-1].weight)
    return net


def images(seed=0, items=2, size=(128, 416)):
    return torch.rand(items, 3, 3, *size, generator=torch.Generator().manual_seed(seed))


def test_it_has_the_1_59_million_parameters_of_zhou_et_al(net):
    widths, kernels = (9, 16, 32, 64, 128, 256, 256, 256), (7, 5, 3, 3, 3, 3, 3)
    by_hand = sum(i * o * k * k + o for i, o, k in zip(widths, widths[1:], kernels)) + 256 * 12 + 12
    assert sum(p.numel() for p in net.parameters()) == by_hand == 1_590_668


def test_its_first_poses_are_the_identity_and_its_signal_reaches_the_last_layer():
    torch.manual_seed(0)
    net, sizes = PoseNet(), []
    for layer in net.layers:
        layer.register_forward_hook(lambda _layer, _given, output: sizes.append(output.square().mean().sqrt().item()))
    assert not net(images()).any()
    assert sizes[-2] > sizes[0] / 10


def test_its_first_layer_begins_with_four_times_the_differences_of_the_images():
    torch.manual_seed(0)
    first = PoseNet().layers[0].requires_grad_(False)
    image, change = torch.rand(2, 1, 3, 64, 64)
    still = first(image.repeat(1, 3, 1, 1))
    seen = [first(torch.cat([image, *(image + change * (n == source) for n in (1, 2))], 1)) - still for source in (1, 2)]
    for moved in seen:
        assert moved.std() / first(change.repeat(1, 3, 1, 1)).std() == pytest.approx(4, rel=0.3)


@pytest.mark.parametrize("view", [0, 1, 2])
def test_target_and_both_sources_are_looked_at(net, view):
    changed = images()
    changed[:, view] = 1 - changed[:, view]
    assert (net(changed) - net(images())).abs().max() > 1e-6


def test_poses_are_float32_under_bfloat16(net):
    with torch.autocast("cpu", torch.bfloat16):
        assert net(images()).dtype == torch.float32


def test_its_output_is_linear_and_scaled(net):
    with torch.no_grad():
        net.layers[-1].weight.zero_()
        net.layers[-1].bias.copy_(torch.arange(-6.0, 6.0))
    expected = 0.1 * torch.arange(-6.0, 6.0).view(1, 2, 6).expand(2, 2, 6)
    assert torch.allclose(net(images()), expected)


@pytest.fixture
def encoded():
    torch.manual_seed(0)
    return EncoderPoseNet("efficientnet_lite0", True).eval()


@pytest.mark.parametrize("bf16", [False, True])
def test_with_an_encoder_one_motion_of_the_car_gives_a_pose_and_its_inverse(encoded, bf16):
    seen = images(size=(64, 96))
    seen[:, 1:] = seen[:, :1]  # both pairs are the same two images
    with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
        poses = encoded(seen)
    to_previous, to_next = pose_matrix(poses).unbind(1)
    assert (to_next - torch.eye(4)).abs().max() > 1e-4 and torch.allclose(to_previous @ to_next, torch.eye(4), atol=1e-6)


@pytest.mark.parametrize(("view", "poses"), [(0, [0, 1]), (1, [0]), (2, [1])])
def test_with_an_encoder_each_pose_is_of_its_own_two_images(encoded, view, poses):
    before, changed = images(size=(64, 96)), images(size=(64, 96))
    changed[:, view] = 1 - changed[:, view]
    moved = (encoded(changed) - encoded(before)).abs().amax(dim=(0, 2)) > 1e-7
    assert moved.nonzero().flatten().tolist() == poses


def test_with_an_encoder_two_equal_images_are_seen_as_one_is(encoded):
    image = images(size=(64, 96))[:, 0]
    alone = make_encoder("efficientnet_lite0", True).eval()
    assert torch.allclose(encoded.encoder(image.repeat(1, 2, 1, 1))[-1], alone(image)[-1], atol=1e-3)
