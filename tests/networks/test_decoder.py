"""The decoder that all depth networks share: sizes, ranges, what it looks at."""

import pytest
import torch
from torch import nn

from dualdepth.networks.decoder import Decoder


@pytest.fixture(scope="module")
def decoder():
    torch.manual_seed(0)
    return Decoder((4, 8, 8, 16, 32)).eval()


def maps(channels=(4, 8, 8, 16, 32), size=(64, 96), seed=0):
    rng = torch.Generator().manual_seed(seed)
    return [torch.randn(2, c, size[0] >> s, size[1] >> s, generator=rng) for s, c in enumerate(channels, 1)]


def test_disparities_come_at_four_scales_with_sixteen_full_size_features(decoder):
    output = decoder(maps())
    assert [tuple(d.shape) for d in output.disparities] == [(2, 1, 64 >> s, 96 >> s) for s in range(4)]
    assert output.features.shape == (2, 16, 64, 96)


@pytest.mark.parametrize("scales", [1, 2, 3])
def test_fewer_scales_give_the_finest_ones(decoder, scales):
    all_four = decoder(maps()).disparities
    found = decoder(maps(), scales).disparities
    assert len(found) == scales
    assert all(torch.equal(a, b) for a, b in zip(found, all_four))


def test_disparity_is_ten_times_the_sigmoid_plus_a_hundredth(decoder):
    decoder = Decoder((4, 8, 8, 16, 32))
    for head in decoder.heads:
        nn.init.zeros_(head.weight)
    for bias, disparity in ((0.0, 5.01), (-200.0, 0.01), (200.0, 10.01)):
        for head in decoder.heads:
            nn.init.constant_(head.bias, bias)
        assert all(torch.allclose(d, torch.tensor(disparity)) for d in decoder(maps()).disparities)


def test_disparities_are_float32_under_bfloat16(decoder):
    with torch.autocast("cpu", torch.bfloat16):
        output = decoder(maps())
    assert output.features.dtype == torch.bfloat16
    assert all(d.dtype == torch.float32 for d in output.disparities)
    assert len(output.disparities[0].unique()) > 1000


@pytest.mark.parametrize("level", range(5))
def test_every_map_of_the_encoder_is_used(decoder, level):
    changed = maps()
    changed[level] = changed[level] + 1
    assert not torch.allclose(decoder(changed).disparities[0], decoder(maps()).disparities[0])


def test_a_missing_stride_2_map_is_left_out():
    decoder = Decoder((None, 8, 8, 16, 32))
    given = maps()
    assert decoder([None, *given[1:]]).disparities[0].shape == (2, 1, 64, 96)


def test_flat_maps_give_flat_disparities_up_to_the_border(decoder):
    flat = [m[..., :1, :1].expand_as(m) for m in maps()]
    for disparity in decoder(flat).disparities:
        assert torch.allclose(disparity, disparity[..., :1, :1].expand_as(disparity), atol=1e-5)
