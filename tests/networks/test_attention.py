"""SA-Attention is the paper's two equations, written out as sums over positions."""

import itertools
from typing import get_args

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from dualdepth.networks.attention import STARTING_RMS, WIDTH, Normalise, SelfAssembledAttention, Similarity

CHANNELS, SIZE = 5, (2, 3)
SIMILARITIES, NORMALISES = get_args(Similarity), get_args(Normalise)
SETTINGS = list(itertools.product(SIMILARITIES, NORMALISES))
SIMILAR = {
    "dot": lambda a, b: sum(x * y for x, y in zip(a, b)),
    "cosine": lambda a, b: sum(x * y for x, y in zip(a, b)) / (sum(x * x for x in a) * sum(y * y for y in b)) ** 0.5,
    "l1": lambda a, b: 1 / (1 + sum(abs(x - y) for x, y in zip(a, b))),
    "l2": lambda a, b: 1 / (1 + sum((x - y) ** 2 for x, y in zip(a, b)) ** 0.5),
}


def embedding_by_hand(attention, features, image):
    """f′ (128, N) of one item: a linear map of features, mean colour of the position's rectangle, x and y."""
    weight = attention.embed.weight.detach().double().numpy()[:, :, 0, 0]
    bias = attention.embed.bias.detach().double().numpy()
    (_, h, w), (_, height, width) = features.shape, image.shape
    columns = []
    for row, column in itertools.product(range(h), range(w)):
        rectangle = image[:, height // h * row : height // h * (row + 1), width // w * column : width // w * (column + 1)]
        place = [2 * column / (w - 1) - 1, 2 * row / (h - 1) - 1]
        columns.append(weight @ np.concatenate([features[:, row, column], rectangle.mean((1, 2)), place]) + bias)
    return np.stack(columns, 1)


def assembled_by_hand(f, similarity, normalise):
    """f″ (128, N) of f′ (128, N): f″_j = Σ_i w_ij f′_i."""
    n = f.shape[1]
    w = np.array([[SIMILAR[similarity](f[:, i], f[:, j]) for j in range(n)] for i in range(n)])
    if normalise == "mean":
        w = w / n
    if normalise == "softmax":
        w = np.array([[np.exp(w[i, j] - w[:, j].max()) / np.exp(w[:, j] - w[:, j].max()).sum() for j in range(n)] for i in range(n)])
    return np.stack([sum(w[i, j] * f[:, i] for i in range(n)) for j in range(n)], 1)


def attention_of(similarity="dot", normalise="none", mixing=True, channels=CHANNELS):
    torch.manual_seed(0)
    return SelfAssembledAttention(channels, similarity, normalise, mixing)


def inputs(items=2, size=SIZE, seed=0):
    """Features (B, 5, h, w) and an image of 4×8 pixels a position."""
    rng = torch.Generator().manual_seed(seed)
    features = torch.randn(items, CHANNELS, *size, generator=rng)
    return features, torch.rand(items, 3, 4 * size[0], 8 * size[1], generator=rng)


@pytest.mark.parametrize(("similarity", "normalise"), SETTINGS)
def test_it_is_the_weighted_sum_over_all_positions(similarity, normalise):
    attention = attention_of(similarity, normalise)
    features, image = inputs()
    with torch.no_grad():
        attention.embed.weight.div_(attention.embed.weight.std() / 0.3)  # weights far from equal, whatever the start
        found = attention(features, image)
    assert found.shape == (2, WIDTH, *SIZE)
    for item in range(2):
        f = embedding_by_hand(attention, features[item].numpy(), image[item].numpy())
        expected = assembled_by_hand(f, similarity, normalise).reshape(WIDTH, *SIZE)
        np.testing.assert_allclose(found[item], expected, rtol=1e-3, atol=1e-4 * np.abs(expected).max())


def test_without_mixing_it_is_the_embedding_of_the_same_size():
    attention, mixed = attention_of(mixing=False), attention_of()
    features, image = inputs()
    with torch.no_grad():
        found = attention(features, image)
    for item in range(2):
        expected = embedding_by_hand(attention, features[item].numpy(), image[item].numpy())
        np.testing.assert_allclose(found[item].flatten(1), expected, atol=1e-5)
    counts = [sum(p.numel() for p in net.parameters()) for net in (attention, mixed)]
    assert counts == [(CHANNELS + 3 + 2) * WIDTH + WIDTH] * 2


@pytest.mark.parametrize("mixing", [True, False])
def test_it_computes_in_float32_under_bfloat16(mixing):
    attention = attention_of(mixing=mixing)
    features, image = (given.bfloat16() for given in inputs(size=(2, 4)))  # coordinates ±1/3 are none of bfloat16's numbers
    with torch.no_grad():
        expected = attention(features.float(), image.float())
        with torch.autocast("cpu", torch.bfloat16):
            found = attention(features, image)
    assert found.dtype == torch.float32
    assert torch.equal(found, expected)


@pytest.mark.parametrize(("similarity", "normalise"), SETTINGS)
def test_gradients_are_those_of_finite_differences_and_finite_for_large_features_and_equal_positions(similarity, normalise):
    attention = attention_of(similarity, normalise)
    embedded = torch.randn(1, 3, 4, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    assert gradcheck(lambda f: f @ attention.weights(f), embedded.requires_grad_())
    features, image = inputs()
    found = attention(1e6 * features, image)
    found.mean().backward()
    assert found.isfinite().all() and all(p.grad.isfinite().all() for p in attention.parameters())
    for value in (0.0, 1.0):
        f = torch.full((1, 4, 6), value, requires_grad=True)
        (f @ attention.weights(f)).sum().backward()
        assert f.grad.isfinite().all()


@pytest.mark.parametrize("mixing", [True, False])
def test_the_scale_is_the_last_training_batchs_root_mean_square(mixing):
    attention = attention_of(mixing=mixing).eval()
    attention(*inputs())
    assert attention.scale is None
    attention.train()
    attention(*inputs(seed=1))
    found = attention(*inputs(seed=2))
    expected = np.sqrt(np.mean(found.detach().numpy().astype(np.float64) ** 2))
    assert attention.scale.item() == pytest.approx(expected, rel=1e-5)
    assert not attention.scale.requires_grad
    attention.eval()
    attention(*inputs(seed=3))
    assert attention.scale.item() == pytest.approx(expected, rel=1e-5)
    assert set(attention.state_dict()) == {"embed.weight", "embed.bias", "gain"}


@pytest.mark.parametrize("scale", [0.1, 1, 10])
@pytest.mark.parametrize(("similarity", "normalise", "mixing"), [*((*setting, True) for setting in SETTINGS), ("dot", "none", False)])
def test_it_starts_at_the_scale_of_the_features_beside_it(similarity, normalise, mixing, scale):
    attention = attention_of(similarity, normalise, mixing)
    first = attention.embed.weight.detach().clone()
    features, image = inputs()
    attention.begin(scale * features, image)
    with torch.no_grad():
        assert attention(scale * features, image).square().mean().sqrt() == pytest.approx(STARTING_RMS, rel=0.02)
    assert torch.equal(attention.embed.weight, first)  # a step of Adam stays small beside them
