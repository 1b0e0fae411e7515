"""LR-Net, HR-Net and the dual network: the paper's overhead, sizes, a frozen LR-Net that sees the 3×3 average, and what it hands over."""

from typing import get_args

import pytest
import torch
from small_nets import as_trained, averaged, with_heads
from torch import nn
from torch.nn import functional as F

from dualdepth.evaluation.cost import count
from dualdepth.networks import Link
from dualdepth.networks.attention import STARTING_RMS
from dualdepth.networks.depth_nets import DualNet, HREncoder, HRNet, LRNet

SMALL, SIZE = (64, 96), (192, 288)
GLOBAL = 16
DEEPEST = 64
LINKS = get_args(Link)


def image(seed=0, items=1, size=SIZE):
    return torch.rand(items, 3, *size, generator=torch.Generator().manual_seed(seed))


def given_to(module):
    """Arguments that a module is handed from now on, as a list that grows."""
    seen = []
    module.register_forward_pre_hook(lambda _module, arguments: seen.append(arguments))
    return seen


def million(number):
    return round(number / 1e6, 3)


# LR-Net


@pytest.mark.slow
@pytest.mark.parametrize(
    ("encoder", "size", "params_m", "gmacs"),
    [("mobilenet_v2", (384, 1248), 5.403, 16.978), ("resnet18", (384, 1248), 16.313, 32.756), ("resnet50", (128, 416), 29.951, 6.229)],
)
def test_parameters_and_macs_of_lr_net_are_those_fitted_to_the_papers_overhead_table(encoder, size, params_m, gmacs):
    cost = count(LRNet(encoder), torch.zeros(1, 3, *size, device="meta"))
    assert (million(cost.params), million(cost.macs / 1e3)) == (params_m, gmacs)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("encoder", "pretrained"),
    [*((name, False) for name in ("resnet18", "resnet50", "mobilenet_v2", "efficientnet_lite0", None)), ("efficientnet_lite0", True)],
)
def test_signals_keep_their_scale_down_the_decoder(encoder, pretrained):
    torch.manual_seed(0)
    net, led = (
        LRNet(encoder, pretrained) if encoder else HRNet(GLOBAL),
        () if encoder else (4, STARTING_RMS * torch.randn(4, GLOBAL, 4, 12)),
    )
    found = []
    for module in (net.decoder.neck, *net.decoder.merge):
        module.register_forward_hook(lambda _module, _given, output: found.append(output.square().mean().sqrt().item()))
    with torch.no_grad():
        net.train()(smooth_image(), *led)
    neck, *levels = found
    assert all(neck / 3 < level < 3 * neck for level in levels)


def smooth_image():
    """Blobs of all sizes, as a picture has; (4, 3, 128, 384)."""
    sizes = [F.interpolate(torch.rand(4, 3, 128 // s, 384 // s), (128, 384), mode="bilinear") for s in (2, 4, 8, 16, 32)]
    return torch.stack(sizes).mean(0)


# HR-Net


@pytest.fixture(scope="module")
def hr_net():
    return as_trained(HRNet(GLOBAL))


def small(seed=0):
    return image(seed, 2, SMALL)


def features(seed=0):
    return torch.randn(2, GLOBAL, SMALL[0] // 32, SMALL[1] // 32, generator=torch.Generator().manual_seed(seed))


def test_images_go_into_hr_net_between_minus_one_and_one():
    encoder = HREncoder().eval()
    seen = given_to(encoder.stages[0])
    with torch.inference_mode():
        encoder(torch.tensor([0.0, 0.5, 1.0]).view(1, 3, 1, 1).expand(1, 3, *SMALL))
    assert torch.equal(seen[0][0][0, :, 0, 0], torch.tensor([-1.0, 0.0, 1.0]))


def test_a_flat_image_has_flat_disparities_up_to_the_border(hr_net):
    """Zeros beyond the border would show as a frame."""
    with torch.inference_mode():
        flat = torch.tensor([0.9, 0.4, 0.1]).view(1, 3, 1, 1).expand(2, 3, *SMALL)
        maps = hr_net.encoder(flat)
        disparities = hr_net(flat, 4, features()[..., :1, :1].expand(features().shape)).disparities
    for found in (*maps, *disparities):
        assert found.abs().max() > 1e-3
        assert torch.allclose(found, found[..., :1, :1].expand_as(found), rtol=1e-3, atol=1e-4 * found.abs().max().item())


def test_global_features_join_the_deepest_map_and_change_every_scale(hr_net):
    seen = given_to(hr_net.decoder.neck)
    with torch.inference_mode():
        deepest = hr_net.encoder(small())[-1]
        plain, led = hr_net(small(), 4, features()), hr_net(small(), 4, features(1))
    assert torch.equal(seen[0][0], torch.cat([deepest, features()], 1))
    assert not any(torch.allclose(a, b) for a, b in zip(plain.disparities, led.disparities))


@pytest.mark.parametrize(
    ("make", "led"), [(lambda: LRNet("resnet18"), ()), (HRNet, ()), (lambda: HRNet(GLOBAL), (4, features()))], ids=["LR", "alone", "HR"]
)
def test_gradients_reach_every_parameter(make, led):
    torch.manual_seed(0)
    net = make()
    output = net(small(), *led)
    (sum(d.sum() for d in output.disparities) + output.features.sum()).backward()
    assert [name for name, p in net.named_parameters() if p.grad is None or not p.grad.any()] == []


# The dual network


@pytest.mark.slow
def test_parameters_and_macs_of_both_are_those_fitted_to_the_papers_overhead_table():
    with torch.device("meta"):  # shapes without values
        dual, given = DualNet(LRNet("resnet50")), torch.zeros(1, 3, 384, 1248)
    both, alone = count(dual, given, with_lr_depth=True), count(dual, given)
    decoder = sum(p.numel() for p in dual.lr_net.decoder.parameters())
    assert (million(both.params), million(both.macs / 1e3)) == (34.360, 25.845)
    assert (million(alone.params - decoder), million(alone.macs / 1e3)) == (27.916, 23.953)


@pytest.mark.slow
@pytest.mark.parametrize("link", LINKS)
def test_the_dual_networks_disparities_come_at_four_scales_and_fewer_are_the_same_to_the_bit(dual_of, link):
    with torch.inference_mode():
        output, *fewer = (dual_of(link).eval()(image(items=2), scales) for scales in (4, 1, 2, 3))
    assert [tuple(d.shape) for d in output.disparities] == [(2, 1, SIZE[0] >> s, SIZE[1] >> s) for s in range(4)]
    assert output.features.shape == (2, 16, *SIZE)
    assert [len(f.disparities) for f in fewer] == [1, 2, 3]
    assert all(torch.equal(a, b) for found in fewer for a, b in zip(found.disparities, output.disparities))
    assert all(torch.equal(found.features, output.features) for found in fewer)


@pytest.mark.slow
@pytest.mark.parametrize("link", LINKS)
def test_training_leaves_lr_net_as_it_was_to_the_bit_and_moves_the_rest(dual_of, link):
    net = dual_of(link)
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
    assert same - {"attention.gain"} == frozen  # fixed before the first step


@pytest.mark.parametrize("link", LINKS)
def test_what_is_handed_over_is_enlarged_three_times_bilinearly(dual_of, link):
    net = dual_of(link).eval()
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


def test_lr_nets_decoder_changes_nothing_and_gives_its_depth_beside(dual_of):
    net = dual_of().eval()
    seen = given_to(net.lr_net.encoder)
    with torch.inference_mode():
        alone = net(image())
        high, low = net(image(), with_lr_depth=True)
        again = net(image())
        expected = net.lr_net(averaged(image()))
    assert len(seen) == 4  # once a forward, and once for the comparison
    for found in (high, again):
        assert all(torch.equal(a, b) for a, b in zip((*found.disparities, found.features), (*alone.disparities, alone.features)))
    assert [tuple(d.shape[-2:]) for d in low.disparities] == [(64 >> s, 96 >> s) for s in range(4)]
    assert all(torch.allclose(a, b, atol=1e-5) for a, b in zip(low.disparities, expected.disparities))


@pytest.mark.slow
def test_under_bfloat16_features_stay_narrow_and_disparities_are_float32_and_finite(dual_of):
    net = dual_of()
    seen = given_to(net.hr_net.decoder.neck)
    with torch.autocast("cpu", torch.bfloat16):
        output = net(image())
    assert all(d.dtype == torch.float32 and d.isfinite().all() for d in output.disparities)
    assert len(output.disparities[0].unique()) > 1000
    assert seen[0][0].dtype == output.features.dtype == torch.bfloat16
    assert net.attention.scale.dtype == torch.float32


def test_a_residual_begins_with_lr_nets_depth_enlarged_above_the_floor(encoder):
    torch.manual_seed(0)
    lr_net = with_heads(LRNet(encoder))
    for head in lr_net.decoder.heads:
        nn.init.constant_(head.bias, -7.0)
    net = DualNet(lr_net, residual=True)
    net.floor.fill_(-7.0)
    net.begin(image(items=2))
    with torch.inference_mode():
        high, low = net(image(), with_lr_depth=True)
        fewer = net(image(), 1)
    assert low.logits[0].std() > 0.1 and 0.1 < (low.logits[0] < -7.0).float().mean() < 0.9
    floored = low.logits[0].clamp(min=-7.0)
    for scale, found in enumerate(high.logits):
        size = (SIZE[0] >> scale, SIZE[1] >> scale)
        assert torch.equal(found, F.interpolate(floored, size, mode="bilinear", align_corners=False))
    assert torch.equal(fewer.logits[0], high.logits[0])
    with_heads(net.hr_net)
    seen = given_to(net.hr_net)
    with torch.inference_mode():
        moved = net(image())
        alone = net.hr_net(*seen[0])
    assert torch.allclose(moved.logits[0], high.logits[0] + alone.logits[0], atol=1e-5)
    assert torch.equal(moved.added[0], alone.logits[0]) and alone.added is None


@pytest.mark.parametrize("link", ["attention", "embedding"])
def test_what_is_handed_over_begins_at_the_scale_of_hr_nets_features(encoder, link):
    net = DualNet(LRNet(encoder), link)
    seen = given_to(net.hr_net)
    net.begin(image(items=2))
    with torch.inference_mode():
        net(image(items=2))
    assert seen[0][2].square().mean().sqrt() == pytest.approx(STARTING_RMS, rel=0.2)  # enlarging smooths
