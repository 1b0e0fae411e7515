"""The decoder that all depth networks share: sizes, ranges, what it looks at."""

import pytest
import torch
from small_nets import with_heads
from torch import nn

from dualdepth.networks.decoder import START_LOGIT, Decoder


@pytest.fixture(scope="module")
def decoder():
    torch.manual_seed(0)
    return with_heads(Decoder((4, 8, 8, 16, 32))).eval()


def maps(channels=(4, 8, 8, 16, 32), size=(64, 96), seed=0):
    rng = torch.Generator().manual_seed(seed)
    return [torch.randn(2, c, size[0] >> s, size[1] >> s, generator=rng) for s, c in enumerate(channels, 1)]


def test_disparity_is_ten_times_the_sigmoid_plus_a_hundredth():
    decoder = Decoder((4, 8, 8, 16, 32))
    for bias, disparity in ((0.0, 5.01), (-200.0, 0.01), (200.0, 10.01)):
        for head in decoder.heads:
            nn.init.constant_(head.bias, bias)
        assert all(torch.allclose(d, torch.tensor(disparity)) for d in decoder(maps()).disparities)


@pytest.mark.parametrize("level", range(5))
def test_every_map_of_the_encoder_is_used(decoder, level):
    changed = maps()
    changed[level] = changed[level] + 1
    assert not torch.allclose(decoder(changed).disparities[0], decoder(maps()).disparities[0])


def test_it_begins_with_one_disparity_everywhere():
    expected = 10 / (1 + torch.tensor(-START_LOGIT).exp()) + 0.01
    assert all(torch.allclose(d, expected) for d in Decoder((4, 8, 8, 16, 32))(maps()).disparities)
