"""Convolutions under autocast on the CPU against float32's, and a GPU's mirrored borders against torch's."""

import pytest
import torch
from torch.nn import functional as F

from dualdepth import geometry
from dualdepth.networks import convolution
from dualdepth.networks.convolution import Conv2d, Reflection, conv3x3
from dualdepth.networks.encoders import make_encoder


@pytest.mark.parametrize("layer", [conv3x3(4, 6), conv3x3(4, 6, stride=2, bias=False), Conv2d(4, 4, 3, groups=4)])
def test_under_autocast_values_and_gradients_are_those_of_float32_but_for_rounding(layer):
    x = torch.rand(2, 4, 8, 10).bfloat16().float().requires_grad_()
    expected = layer(x)
    slopes = torch.autograd.grad(expected.square().sum(), [x, *layer.parameters()])
    with torch.autocast("cpu", torch.bfloat16):
        found = layer(x)
    torch.testing.assert_close(found, expected.bfloat16(), rtol=0.02, atol=0.02)
    for slope, other in zip(slopes, torch.autograd.grad(found.float().square().sum(), [x, *layer.parameters()])):
        torch.testing.assert_close(other, slope, rtol=0.02, atol=0.02 * float(slope.abs().max()))


@pytest.mark.parametrize("name", ["efficientnet_lite0", "mobilenet_v2"])
def test_a_filter_for_each_channel_is_computed_in_float32(name):
    layers = [layer for layer in make_encoder(name).modules() if isinstance(layer, torch.nn.Conv2d) and layer.groups > 1]
    x = torch.rand(2, layers[-1].in_channels, 6, 10)
    with torch.autocast("cpu", torch.bfloat16):
        found = layers[-1](x)
    assert len(layers) >= 16 and torch.equal(found, layers[-1](x).bfloat16())


@pytest.mark.parametrize("padding", [(1, 1, 1, 1), (3, 3, 3, 3), (0, 2, 1, 0)])
@pytest.mark.parametrize("layout", [torch.contiguous_format, torch.channels_last])
def test_a_gpus_mirrored_borders_are_torchs_and_keep_the_layout(padding, layout):
    x = torch.rand(2, 3, 4, 7, dtype=torch.float64).contiguous(memory_format=layout).requires_grad_()
    found, expected = Reflection.apply(x, padding), F.pad(x, padding, mode="reflect")
    assert torch.equal(found, expected) and found.is_contiguous(memory_format=layout)
    weights = torch.rand_like(expected)
    slopes = [torch.autograd.grad((mirrored * weights).sum(), x)[0] for mirrored in (found, expected)]
    torch.testing.assert_close(*slopes)


@pytest.mark.parametrize("size", [(2, 7), (1, 3)])
def test_a_map_with_too_few_pixels_to_mirror_is_an_error(size):
    with pytest.raises(RuntimeError):
        Reflection.apply(torch.zeros(1, 1, *size), (3, 3, 2, 2))


@pytest.mark.slow
def test_a_compiler_can_follow_a_gpus_borders_and_samples(monkeypatch):
    monkeypatch.setattr(convolution, "GPU", "cpu")
    net = torch.nn.Sequential(conv3x3(3, 4), torch.nn.ELU(), conv3x3(4, 2))

    def work(image, pixel):
        return geometry.gathered(net(image), pixel)

    image, pixel = torch.rand(2, 3, 8, 12), 7 * torch.rand(2, 4, 5, 2)
    found = torch.compile(work, backend="aot_eager", fullgraph=True, dynamic=False)(image, pixel)
    expected = work(image, pixel)
    torch.testing.assert_close(found, expected)
    for slopes in zip(*(torch.autograd.grad(values.square().sum(), net.parameters()) for values in (found, expected))):
        torch.testing.assert_close(*slopes)
