"""HR-Net: a slim encoder, the shared decoder, and room for global features at stride 32."""

import pytest
import torch
from torch import nn

from dualdepth.networks.depth_nets import HREncoder, HRNet

WIDTHS = (32, 64, 128, 128, 128)
SIZE = (64, 96)
GLOBAL = 16


@pytest.fixture(scope="module")
def net():
    return randomised(HRNet(GLOBAL))


def randomised(net):
    """In eval mode, with the batch norm statistics of a trained network, so that a zero at the border would show."""
    torch.manual_seed(0)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, std=0.3)
            nn.init.uniform_(module.running_var, 0.5, 2)
            nn.init.normal_(module.bias, std=0.3)
    return net.eval()


def image(seed=0):
    return torch.rand(2, 3, *SIZE, generator=torch.Generator().manual_seed(seed))


def features(seed=0):
    return torch.randn(2, GLOBAL, SIZE[0] // 32, SIZE[1] // 32, generator=torch.Generator().manual_seed(seed))


def given_to(module):
    """What a module is handed from now on, as a list that grows."""
    seen = []
    module.register_forward_pre_hook(lambda _module, arguments: seen.append(arguments[0]))
    return seen


def test_maps_have_strides_2_to_32_and_the_declared_widths():
    with torch.inference_mode():
        maps = HREncoder().eval()(image())
    assert [tuple(m.shape) for m in maps] == [(2, c, SIZE[0] // s, SIZE[1] // s) for c, s in zip(WIDTHS, (2, 4, 8, 16, 32))]


def test_each_stage_has_a_strided_and_a_plain_convolution_with_batch_norm():
    by_hand = sum(9 * i * o + 9 * o * o + 2 * 2 * o for i, o in zip((3, *WIDTHS), WIDTHS))
    assert sum(p.numel() for p in HREncoder().parameters()) == by_hand


def test_images_go_in_between_minus_one_and_one():
    encoder = HREncoder().eval()
    seen = given_to(encoder.stages[0])
    with torch.inference_mode():
        encoder(torch.tensor([0.0, 0.5, 1.0]).view(1, 3, 1, 1).expand(1, 3, *SIZE))
    assert torch.equal(seen[0][0, :, 0, 0], torch.tensor([-1.0, 0.0, 1.0]))


def test_a_flat_image_has_flat_disparities_up_to_the_border(net):
    """Zeros beyond the border would show as a frame."""
    with torch.inference_mode():
        flat = torch.tensor([0.9, 0.4, 0.1]).view(1, 3, 1, 1).expand(2, 3, *SIZE)
        maps = net.encoder(flat)
        disparities = net(flat, 4, features()[..., :1, :1].expand(features().shape)).disparities
    for found in (*maps, *disparities):
        assert found.abs().max() > 1e-3
        assert torch.allclose(found, found[..., :1, :1].expand_as(found), rtol=1e-3, atol=1e-4 * found.abs().max().item())


def test_disparities_come_at_four_scales_with_sixteen_full_size_features(net):
    with torch.inference_mode():
        output = net(image(), 4, features())
    assert [tuple(d.shape) for d in output.disparities] == [(2, 1, SIZE[0] >> s, SIZE[1] >> s) for s in range(4)]
    assert output.features.shape == (2, 16, *SIZE)


@pytest.mark.parametrize("scales", [1, 2, 3])
def test_fewer_scales_give_the_same_finest_ones_to_the_bit(net, scales):
    with torch.inference_mode():
        all_four, fewer = net(image(), 4, features()), net(image(), scales, features())
    assert len(fewer.disparities) == scales
    assert all(torch.equal(a, b) for a, b in zip(fewer.disparities, all_four.disparities))
    assert torch.equal(fewer.features, all_four.features)


def test_global_features_join_the_deepest_map_and_change_every_scale(net):
    seen = given_to(net.decoder.neck)
    with torch.inference_mode():
        deepest = net.encoder(image())[-1]
        plain, led = net(image(), 4, features()), net(image(), 4, features(1))
    assert torch.equal(seen[0], torch.cat([deepest, features()], 1))
    assert not any(torch.allclose(a, b) for a, b in zip(plain.disparities, led.disparities))


def test_by_itself_it_has_no_room_for_global_features():
    by_itself = HRNet().eval()
    assert by_itself.decoder.neck[0].in_channels == 128
    assert HRNet(GLOBAL).decoder.neck[0].in_channels == 128 + GLOBAL
    with torch.inference_mode():
        assert by_itself(image()).disparities[0].shape == (2, 1, *SIZE)
        with pytest.raises(RuntimeError):
            by_itself(image(), 4, features())


def test_under_bfloat16_features_stay_narrow_and_disparities_are_float32(net):
    seen = given_to(net.decoder.neck)
    with torch.inference_mode(), torch.autocast("cpu", torch.bfloat16):
        output = net(image(), 4, features())
    assert seen[0].dtype == output.features.dtype == torch.bfloat16
    assert all(d.dtype == torch.float32 and d.isfinite().all() for d in output.disparities)


@pytest.mark.parametrize("global_channels", [0, GLOBAL])
def test_gradients_reach_every_parameter(global_channels):
    torch.manual_seed(0)
    net = HRNet(global_channels)
    output = net(image(), 4, features() if global_channels else None)
    (sum(d.sum() for d in output.disparities) + output.features.sum()).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


def test_batch_norm_follows_the_batches_in_training_alone():
    net = HRNet()
    statistics = {name: value.clone() for name, value in net.named_buffers()}
    net.eval()(image())
    assert all(torch.equal(value, statistics[name]) for name, value in net.named_buffers())
    net.train()(image())
    assert len(statistics) == 3 * 10
    assert not any(torch.equal(value, statistics[name]) for name, value in net.named_buffers())
