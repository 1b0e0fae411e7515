"""SA-Attention is the paper's two equations, written out as sums over positions."""

import itertools
from typing import get_args

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck

from dualdepth.networks.attention import STARTING_RMS, WIDTH, Normalise, SelfAssembledAttention, Similarity, coordinates, distances

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


def embedded(items=1, positions=6, width=7, dtype=torch.float64):
    return torch.randn(items, width, positions, generator=torch.Generator().manual_seed(3), dtype=dtype)


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


@pytest.mark.parametrize(("similarity", "normalise"), SETTINGS)
def test_mixed_positions_give_mixed_results(similarity, normalise):
    """No position is special but by its coordinates."""
    attention = attention_of(similarity, normalise)
    with torch.no_grad():
        attention.embed.weight[:, -2:] = 0
    features, _ = inputs(size=(3, 4))
    order = torch.randperm(12, generator=torch.Generator().manual_seed(1))
    mixed = features.flatten(2)[:, :, order].unflatten(2, (3, 4))
    with torch.no_grad():
        plain, found = (attention(f, torch.full((2, 3, 12, 16), 0.5)).flatten(2) for f in (features, mixed))
    assert not torch.allclose(found, plain, rtol=1e-2, atol=0)
    assert torch.allclose(found, plain[:, :, order], rtol=1e-3, atol=1e-5 * plain.abs().max().item())


@pytest.mark.parametrize("normalise", ["none", "mean"])
def test_each_pair_weighs_the_same_both_ways(normalise):
    for similarity in SIMILARITIES:
        w = attention_of(similarity, normalise).weights(embedded())
        assert torch.allclose(w, w.mT)
        assert not torch.allclose(w, w[:, :1])


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_softmax_weights_of_a_position_sum_to_one(similarity):
    w = attention_of(similarity, "softmax").weights(embedded())
    assert torch.allclose(w.sum(1), torch.ones(1, 6, dtype=torch.float64))
    assert not torch.allclose(w.sum(2), torch.ones(1, 6, dtype=torch.float64), atol=1e-3)


@pytest.mark.parametrize("similarity", ["cosine", "l1", "l2"])
def test_a_position_is_most_similar_to_itself(similarity):
    w = attention_of(similarity).weights(embedded())
    assert torch.allclose(w.diagonal(dim1=1, dim2=2), torch.ones(1, 6, dtype=torch.float64), atol=2e-4)
    assert (w - torch.eye(6)).max() < 0.99


def test_positions_do_not_look_at_other_items():
    attention = attention_of()
    features, image = inputs()
    with torch.no_grad():
        assert torch.allclose(attention(features, image)[:1], attention(features[:1], image[:1]), rtol=1e-5, atol=1e-4)


def test_coordinates_go_from_minus_one_to_one_x_along_the_width():
    found = coordinates(torch.zeros(2, 9, 3, 5))
    x, y = torch.tensor([-1, -0.5, 0, 0.5, 1]), torch.tensor([-1.0, 0, 1])
    assert torch.equal(found, torch.stack([x.expand(3, 5), y[:, None].expand(3, 5)]).expand(2, 2, 3, 5))


def test_features_mean_colours_and_coordinates_are_embedded():
    attention, seen = attention_of(), []
    attention.embed.register_forward_pre_hook(lambda _module, given: seen.append(given[0]))
    features, image = inputs()
    attention(features, image)
    assert torch.equal(seen[0][:, :CHANNELS], features)
    assert torch.allclose(seen[0][:, CHANNELS:-2], image.reshape(2, 3, 2, 4, 3, 8).mean((3, 5)))
    assert torch.equal(seen[0][:, -2:], coordinates(features))


@pytest.mark.parametrize("similarity", SIMILARITIES)
def test_without_mixing_it_is_the_embedding_of_the_same_size(similarity):
    attention, mixed = attention_of(similarity, mixing=False), attention_of(similarity)
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


def test_it_runs_on_the_meta_device_where_operations_are_counted():
    features, image = (given.to("meta") for given in inputs())
    assert attention_of().to("meta")(features, image).shape == (2, WIDTH, *SIZE)


@pytest.mark.parametrize(("similarity", "normalise"), SETTINGS)
def test_large_features_give_finite_results_and_gradients(similarity, normalise):
    attention = attention_of(similarity, normalise)
    features, image = inputs()
    found = attention(1e6 * features, image)
    found.mean().backward()
    assert found.isfinite().all()
    assert all(p.grad.isfinite().all() for p in attention.parameters())


@pytest.mark.parametrize("value", [0.0, 1.0])
@pytest.mark.parametrize(("similarity", "normalise"), SETTINGS)
def test_equal_positions_have_finite_gradients(similarity, normalise, value):
    f = torch.full((1, 4, 6), value, requires_grad=True)
    (f @ attention_of(similarity, normalise).weights(f)).sum().backward()
    assert f.grad.isfinite().all()


@pytest.mark.parametrize(("similarity", "normalise"), SETTINGS)
def test_its_gradients_are_those_of_finite_differences(similarity, normalise):
    attention = attention_of(similarity, normalise)
    assert gradcheck(lambda f: f @ attention.weights(f), embedded(positions=4, width=3).requires_grad_())


@pytest.mark.parametrize("order", [1, 2])
def test_distances_have_the_gradients_of_finite_differences_off_the_diagonal(order):
    apart = ~torch.eye(4, dtype=torch.bool)
    assert gradcheck(lambda f: distances(f, order)[:, apart], embedded(positions=4, width=3).requires_grad_())


def test_distances_are_scipys():
    from scipy.spatial.distance import cdist

    f = embedded()
    for order, metric in ((1, "cityblock"), (2, "euclidean")):
        np.testing.assert_allclose(distances(f, order)[0], cdist(f[0].T, f[0].T, metric), atol=2e-4)


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
    assert set(attention.state_dict()) == {"embed.weight", "embed.bias"}


@pytest.mark.parametrize("scale", [0.1, 1, 10])
@pytest.mark.parametrize(("similarity", "normalise", "mixing"), [*((*setting, True) for setting in SETTINGS), ("dot", "none", False)])
def test_it_starts_at_the_scale_of_the_features_beside_it(similarity, normalise, mixing, scale):
    attention = attention_of(similarity, normalise, mixing)
    first = attention.embed.weight.detach().clone()
    features, image = inputs()
    attention.begin(scale * features, image)
    with torch.no_grad():
        assert attention(scale * features, image).square().mean().sqrt() == pytest.approx(STARTING_RMS, rel=0.02)
    gain = attention.embed.weight / first
    assert gain.std() < 1e-4 * gain.mean() and gain.mean() > 0
