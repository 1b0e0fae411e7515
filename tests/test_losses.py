"""The losses against slow NumPy readings of the paper, finite differences, and inputs that degenerate."""

import numpy as np
import pytest
import torch
from slow_losses import slow_anchor, slow_minimum, slow_photometric, slow_smoothness, slow_total

from dualdepth import geometry
from dualdepth.losses import anchor, feature_error, mean_over_seen, minimum_over_sources, photometric_error, smoothness, total_loss
from dualdepth.settings import Loss

ALPHA = 0.85


def settings(*weights, **others):
    """Settings with these λ1, λ2, λ3."""
    photometric, smoothness, feature = weights or (1.0, 0.1, 0.01)
    return Loss(photometric=photometric, smoothness=smoothness, feature=feature, alpha=ALPHA, **{"mean_disparity": 10.0} | others)


AUTOMASK = settings(beyond_paper_automask=True)


def noise(*shape, seed=0, dtype=torch.float32):
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=dtype)


def batch(size=(16, 24), seed=0, dtype=torch.float32, items=1):
    """Everything `total_loss` takes, with a motion of a pixel or two."""
    height, width = size
    k = torch.tensor([[0.6 * width, 0, 0.48 * width], [0, 0.7 * width, 0.53 * height], [0, 0, 1]], dtype=dtype).expand(items, 3, 3)
    poses = torch.tensor([[0.012, -0.004, 0.01, 0.01, 0.02, -0.03], [-0.009, 0.006, -0.012, -0.02, 0.01, 0.02]], dtype=dtype)
    return {
        "images": noise(items, 3, 3, height, width, seed=seed, dtype=dtype),
        "intrinsics": k,
        "disparities": [0.5 + noise(items, 1, height >> s, width >> s, seed=seed + 1 + s, dtype=dtype) for s in range(2)],
        "poses": poses.expand(items, 2, 6),
        "features": (
            noise(items, 5, height, width, seed=seed + 7, dtype=dtype),
            noise(items, 2, 5, height, width, seed=seed + 8, dtype=dtype),
        ),
        "settings": settings(),
    }


def leaves(given):
    """The tensors of `batch` that a network makes, as leaves with gradients."""
    made = [given["poses"].clone(), *given["disparities"], *given["features"]]
    made = [tensor.detach().clone().requires_grad_() for tensor in made]
    scales = len(given["disparities"])
    return made, given | {"poses": made[0], "disparities": made[1 : 1 + scales], "features": tuple(made[1 + scales :])}


# The pieces


def test_photometric_error_equals_a_slow_reference():
    a, b = noise(2, 3, 6, 8, seed=1, dtype=torch.float64), noise(2, 3, 6, 8, seed=2, dtype=torch.float64)
    found = photometric_error(a, b, ALPHA)
    assert found.shape == (2, 1, 6, 8)
    assert np.allclose(found[1, 0].numpy(), slow_photometric(a[1].numpy(), b[1].numpy()), atol=1e-12)


def test_feature_error_is_the_euclidean_distance_over_channels():
    a, b = noise(2, 16, 4, 5, seed=1, dtype=torch.float64), noise(2, 16, 4, 5, seed=2, dtype=torch.float64)
    expected = np.linalg.norm((a - b).numpy(), axis=1)
    assert np.allclose(feature_error(a, b)[:, 0].numpy(), expected, atol=1e-6)


def test_smoothness_equals_the_slow_definition_on_mean_normalised_disparity():
    disparity, image = 0.1 + noise(1, 1, 6, 9, seed=1, dtype=torch.float64), noise(1, 3, 6, 9, seed=2, dtype=torch.float64)
    assert smoothness(disparity, image).item() == pytest.approx(slow_smoothness(disparity[0, 0].numpy(), image[0].numpy()), abs=1e-12)


def test_the_anchor_equals_its_slow_definition_and_lets_go_where_there_is_texture():
    image = 0.03 * noise(1, 3, 12, 16, seed=1, dtype=torch.float64)
    added = [noise(1, 1, 12 >> s, 16 >> s, seed=s) - 0.5 for s in range(2)]
    expected = slow_anchor([r[0, 0].numpy() for r in added], image[0].numpy())
    assert anchor(added, image).item() == pytest.approx(expected, abs=1e-6) and expected > 0.05
    assert anchor(added, 30 * image) < 1e-6


def test_the_minimum_over_sources_equals_a_slow_reference():
    errors, valid = noise(1, 3, 5, 6, seed=1, dtype=torch.float64), noise(1, 3, 5, 6, seed=2) > 0.6
    assert not valid.any(dim=1).all()
    found = mean_over_seen(*minimum_over_sources(errors, valid)).item()
    assert found == pytest.approx(slow_minimum(errors[0].numpy(), valid[0].numpy()), abs=1e-12)


# The whole


def test_the_total_loss_equals_a_slow_reading_of_the_paper():
    given = batch()
    found = total_loss(**given)
    features = np.concatenate([given["features"][0][:, None], given["features"][1]], axis=1)[0]
    expected = slow_total(
        given["images"][0].numpy(),
        given["intrinsics"][0].numpy(),
        [d[0, 0].double().numpy() for d in given["disparities"]],
        given["poses"][0].numpy(),
        features,
        (1.0, 0.1, 0.01),
        10.0,
    )
    for name, value in zip(("total", "photometric", "smoothness", "feature"), expected):
        assert getattr(found, name).item() == pytest.approx(value, rel=1e-3), name


@pytest.mark.slow
def test_gradients_of_the_total_loss_equal_finite_differences(monkeypatch):
    grid = geometry.pixel_grid
    monkeypatch.setattr(geometry, "pixel_grid", lambda *arguments: grid(*arguments).double())
    monkeypatch.setattr(torch.Tensor, "float", torch.Tensor.double)  # the loss computes in float32; the check needs float64
    given = batch(size=(4, 6), dtype=torch.float64)
    made, _ = leaves(given | {"features": (given["features"][0][:, :2], given["features"][1][:, :, :2])})

    def loss(poses, fine, coarse, target, sources):
        return total_loss(**given | {"poses": poses, "disparities": [fine, coarse], "features": (target, sources)}).total

    assert torch.autograd.gradcheck(loss, made, eps=1e-7, atol=1e-4)


def test_items_of_a_batch_do_not_mix():
    first, second = batch(seed=0), batch(seed=30)
    both = {
        "images": torch.cat([first["images"], second["images"]]),
        "intrinsics": first["intrinsics"].expand(2, 3, 3),
        "disparities": [torch.cat(pair) for pair in zip(first["disparities"], second["disparities"])],
        "poses": first["poses"].expand(2, 2, 6),
        "features": tuple(torch.cat(pair) for pair in zip(first["features"], second["features"])),
    }
    together = total_loss(**first | both)
    apart = total_loss(**first), total_loss(**second)
    # a pixel counts the same wherever it is, so the batch is the mean weighted by the pixels that are seen
    assert torch.allclose(together.error, torch.cat([a.error for a in apart]), atol=1e-5)
    assert together.smoothness.item() == pytest.approx(sum(a.smoothness.item() for a in apart) / 2, rel=1e-5)


def test_the_log_shows_what_the_loss_saw():
    given = batch()
    found = total_loss(**given | {"disparities": given["disparities"][:1]})
    seen = found.valid_share.item() * 16 * 24
    assert 0 < found.valid_share < 1
    assert found.error.sum().item() / seen == pytest.approx(found.photometric.item(), rel=1e-5)
    assert found.synthesized.shape == (1, 3, 16, 24)
    assert not (found.synthesized.requires_grad or found.error.requires_grad)


def test_the_automask_drops_what_stands_still_and_only_when_asked():
    given = batch()
    for sources in ([0, 0], [0, 2]):  # both stand still, or one: what explains a pixel best counts
        still = given | {"images": given["images"][:, [0, *sources]]}
        assert total_loss(**still | {"settings": AUTOMASK}).photometric == 0
        assert total_loss(**still).photometric > 0.01


def test_at_full_resolution_a_coarse_disparity_is_compared_as_if_it_were_fine():
    given = batch()
    flat = given | {"disparities": [torch.full((1, 1, 16 >> s, 24 >> s), 0.7) for s in range(2)]}
    one = total_loss(**flat | {"disparities": flat["disparities"][:1]})
    full = total_loss(**flat | {"settings": settings(beyond_paper_full_resolution=True)})
    assert full.photometric.item() == pytest.approx(one.photometric.item(), rel=1e-5)
    assert total_loss(**flat).photometric.item() != pytest.approx(one.photometric.item(), rel=1e-2)


def test_where_no_source_sees_anything_only_smoothness_is_left():
    made, given = leaves(batch())
    behind = given["poses"].detach().clone()
    behind[..., 2] = -100
    found = total_loss(**given | {"poses": behind.requires_grad_()})
    found.total.backward()
    assert found.photometric == found.feature == found.valid_share == 0
    assert (behind.grad == 0).all()
    assert made[1].grad.isfinite().all()


def test_bfloat16_disparities_and_features_are_compared_in_float32():
    given = batch()
    rounded = given | {
        "disparities": [d.bfloat16() for d in given["disparities"]],
        "features": tuple(f.bfloat16() for f in given["features"]),
    }
    found = total_loss(**rounded)
    assert found.total.dtype == torch.float32
    widened = {"disparities": [d.float() for d in rounded["disparities"]], "features": tuple(f.float() for f in rounded["features"])}
    assert found.total == total_loss(**given | widened).total
