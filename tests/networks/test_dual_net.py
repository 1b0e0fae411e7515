"""The dual network: the paper's overhead, a frozen LR-Net that sees the 3×3 average, and what it hands over."""

from typing import get_args

import pytest
import torch
from torch import nn

from dualdepth.evaluation.cost import count
from dualdepth.networks.architecture import Link
from dualdepth.networks.attention import SelfAssembledAttention
from dualdepth.networks.depth_nets import BothDepths, DualNet, LRNet

SIZE = (192, 288)
DEEPEST = 64
LINKS = get_args(Link)


@pytest.fixture(scope="module")
def dual_of(encoder):
    """A dual network with new weights, in eval mode."""

    def make(link="attention", **settings):
        torch.manual_seed(0)
        return DualNet(LRNet(encoder), link, **settings).eval()

    return make


def image(seed=0, items=1):
    return torch.rand(items, 3, *SIZE, generator=torch.Generator().manual_seed(seed))


def averaged(image):
    """3×3 means, one after the other."""
    return torch.stack([image[..., row::3, column::3] for row in range(3) for column in range(3)]).double().mean(0).float()


def given_to(module):
    """Arguments that a module is handed from now on, as a list that grows."""
    seen = []
    module.register_forward_pre_hook(lambda _module, arguments: seen.append(arguments))
    return seen


def million(number):
    return round(number / 1e6, 3)


def test_parameters_and_macs_are_those_fitted_to_the_papers_overhead_table():
    with torch.device("meta"):  # shapes without values
        dual, given = DualNet(LRNet("resnet50")), torch.zeros(1, 3, 384, 1248)
    both, alone = count(BothDepths(dual), given), count(dual, given)
    decoder = sum(p.numel() for p in dual.lr_net.decoder.parameters())
    assert (million(both.params), million(both.macs / 1e3)) == (34.360, 25.845)
    assert (million(alone.params - decoder), million(alone.macs / 1e3)) == (27.916, 23.953)


def test_without_sa_the_neck_takes_all_of_resnet50s_channels_beside_hr_nets():
    with torch.device("meta"):
        direct, given = DualNet(LRNet("resnet50"), "direct"), torch.zeros(1, 3, 384, 1248)
    seen = given_to(direct.hr_net.decoder.neck)
    direct(given)
    assert direct.attention is None
    assert seen[0][0].shape == (1, 2048 + 128, 12, 39)


def test_the_embedding_alone_is_as_large_and_saves_the_two_products(dual_of):
    mixed, alone = (count(dual_of(link), torch.zeros(1, 3, *SIZE, device="meta")) for link in ("attention", "embedding"))
    assert mixed.params == alone.params
    assert mixed.macs - alone.macs == 2 * 6 * 6 * 128


@pytest.mark.parametrize("link", LINKS)
def test_disparities_come_at_four_scales_and_fewer_are_the_same_to_the_bit(dual_of, link):
    net = dual_of(link)
    with torch.inference_mode():
        output = net(image(items=2))
        fewer = [net(image(items=2), scales).disparities for scales in (1, 2, 3)]
    assert [tuple(d.shape) for d in output.disparities] == [(2, 1, SIZE[0] >> s, SIZE[1] >> s) for s in range(4)]
    assert output.features.shape == (2, 16, *SIZE)
    assert [len(f) for f in fewer] == [1, 2, 3]
    assert all(torch.equal(a, b) for found in fewer for a, b in zip(found, output.disparities))


@pytest.mark.parametrize("link", LINKS)
def test_training_leaves_lr_net_as_it_was_to_the_bit_and_moves_the_rest(dual_of, link):
    net = dual_of(link).train()
    before = {name: value.clone() for name, value in net.state_dict().items()}
    optimizer = torch.optim.AdamW(net.parameters(), lr=1e-2, weight_decay=0.1)
    for step in range(2):
        optimizer.zero_grad()
        output = net(image(seed=step))
        (sum(d.mean() for d in output.disparities) + output.features.square().mean()).backward()
        optimizer.step()
    assert all(p.grad is None and not p.requires_grad for p in net.lr_net.parameters())
    same = {name for name, value in net.state_dict().items() if torch.equal(value, before[name])}
    frozen = {f"lr_net.{name}" for name in net.lr_net.state_dict()}
    assert {"running_mean", "running_var", "num_batches_tracked"} <= {name.split(".")[-1] for name in frozen}
    assert same == frozen


def test_lr_net_stays_in_eval_mode(encoder):
    lr_net = LRNet(encoder).train()
    whole = nn.Sequential(DualNet(lr_net))
    for mode in (True, False, True):
        modes = [{m.training for m in part.modules()} for part in (lr_net, whole.train(mode)[0].hr_net, whole[0].attention)]
        assert modes == [{False}, {mode}, {mode}]
    assert not any(m.training for m in DualNet(LRNet(encoder)).lr_net.modules())  # before anyone calls train()


def test_lr_net_sees_the_image_averaged_3_by_3(dual_of):
    net = dual_of()
    seen = given_to(net.lr_net.encoder)
    with torch.inference_mode():
        net(image())
    assert len(seen) == 1
    assert seen[0][0].shape == (1, 3, 64, 96)
    assert torch.allclose(seen[0][0], averaged(image()), atol=1e-6)


def test_sa_attention_is_given_lr_nets_deepest_map_and_the_low_resolution_image(dual_of):
    net = dual_of()
    seen = given_to(net.attention)
    with torch.inference_mode():
        net(image())
        expected = net.lr_net.encoder(averaged(image()))[-1]
    features, low = seen[0]
    assert features.shape == (1, DEEPEST, 2, 3)
    assert torch.allclose(features, expected, atol=1e-5)
    assert torch.allclose(low, averaged(image()), atol=1e-6)


@pytest.mark.parametrize("link", LINKS)
def test_what_is_handed_over_is_enlarged_three_times_bilinearly(dual_of, link):
    net = dual_of(link)
    seen = given_to(net.hr_net)
    with torch.inference_mode():
        net(image(), 2)
        low = averaged(image())
        deepest = net.lr_net.encoder(low)[-1]
        handed = deepest if link == "direct" else net.attention(deepest, low)
    given, scales, enlarged = seen[0]
    assert torch.equal(given, image())
    assert scales == 2
    assert enlarged.shape == (1, DEEPEST if link == "direct" else 128, 6, 9)
    for found, expected in (
        (enlarged[..., 1::3, 1::3], handed),  # the centre of each 3×3 is the position itself
        (enlarged[..., 1::3, 2:-1:3], (2 * handed[..., :-1] + handed[..., 1:]) / 3),
        (enlarged[..., 3, 1::3], (handed[..., 0, :] + 2 * handed[..., 1, :]) / 3),
        (enlarged[..., 0, ::8], handed[..., 0, ::2]),  # the border's value beyond the last centre
    ):
        assert torch.allclose(found, expected, atol=1e-4 * handed.abs().max().item())


@pytest.mark.parametrize(("link", "mixes"), [("attention", True), ("embedding", False)])
def test_the_link_and_its_settings_reach_sa_attention(dual_of, link, mixes):
    attention = dual_of(link, similarity="l2", normalise="mean").attention
    assert isinstance(attention, SelfAssembledAttention)
    assert (attention.mixing, attention.similarity, attention.normalise) == (mixes, "l2", "mean")


@pytest.mark.parametrize("link", LINKS)
def test_lr_net_leads(dual_of, link):
    """Other weights in LR-Net's encoder give another depth; its decoder has no say."""
    net = dual_of(link)
    with torch.inference_mode():
        plain = net(image()).disparities[0]
        nn.init.normal_(net.lr_net.decoder.heads[0].weight)
        assert torch.equal(net(image()).disparities[0], plain)
        last = [m for m in net.lr_net.encoder.modules() if isinstance(m, nn.BatchNorm2d)][-1]
        nn.init.normal_(last.weight)
        assert not torch.equal(net(image()).disparities[0], plain)


def test_lr_nets_decoder_changes_nothing_and_gives_its_depth_beside(dual_of):
    net = dual_of()
    seen = given_to(net.lr_net.encoder)
    with torch.inference_mode():
        alone = net(image())
        high, low = BothDepths(net)(image())
        again = net(image())
        expected = net.lr_net(averaged(image()))
    assert len(seen) == 4  # once a forward, and once for the comparison
    assert not net.lr_net.encoder._forward_hooks
    for found in (high, again):
        assert all(torch.equal(a, b) for a, b in zip((*found.disparities, found.features), (*alone.disparities, alone.features)))
    assert [tuple(d.shape[-2:]) for d in low.disparities] == [(64 >> s, 96 >> s) for s in range(4)]
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(low.disparities, expected.disparities))


def test_disparities_are_float32_and_finite_under_bfloat16(dual_of):
    net = dual_of().train()
    with torch.autocast("cpu", torch.bfloat16):
        output = net(image())
    assert all(d.dtype == torch.float32 and d.isfinite().all() for d in output.disparities)
    assert output.features.dtype == torch.bfloat16
    assert net.attention.scale.dtype == torch.float32
