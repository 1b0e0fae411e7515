"""The losses against slow NumPy readings of the paper, finite differences, and inputs that degenerate."""

import numpy as np
import pytest
import torch
from slow_losses import slow_minimum, slow_photometric, slow_smoothness, slow_ssim, slow_total

from dualdepth import geometry
from dualdepth.losses import feature_error, mean_over_seen, minimum_over_sources, photometric_error, smoothness, ssim, total_loss
from dualdepth.settings import Loss

ALPHA = 0.85


def mean_of_minimum(errors, valid):
    return mean_over_seen(*minimum_over_sources(errors, valid))


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


def test_ssim_equals_a_slow_reference_up_to_the_border():
    a, b = noise(1, 1, 7, 9, seed=1, dtype=torch.float64), noise(1, 1, 7, 9, seed=2, dtype=torch.float64)
    assert np.allclose(ssim(a, b)[0, 0].numpy(), slow_ssim(a[0, 0].numpy(), b[0, 0].numpy()), atol=1e-12)


def test_ssim_of_an_image_with_itself_is_one_and_with_another_is_symmetric():
    a, b = noise(2, 3, 8, 8), noise(2, 3, 8, 8, seed=1)
    assert torch.allclose(ssim(a, a), torch.ones_like(a), atol=1e-4)
    assert torch.equal(ssim(a, b), ssim(b, a))


def test_ssim_of_flat_images_is_its_luminance_term():
    a, b = torch.full((1, 1, 5, 5), 0.2), torch.full((1, 1, 5, 5), 0.6)
    assert torch.allclose(ssim(a, b), torch.tensor((2 * 0.12 + 1e-4) / (0.04 + 0.36 + 1e-4)), atol=1e-4)


def test_kornias_gaussian_ssim_gives_other_values_than_the_fields_box():
    from kornia.metrics import ssim as kornia_ssim

    a, b = noise(1, 1, 12, 12, seed=1), noise(1, 1, 12, 12, seed=2)
    inside = (..., slice(2, -2), slice(2, -2))
    assert (kornia_ssim(a, b, 3)[inside] - ssim(a, b)[inside]).abs().max() > 0.02


def test_photometric_error_equals_a_slow_reference():
    a, b = noise(2, 3, 6, 8, seed=1, dtype=torch.float64), noise(2, 3, 6, 8, seed=2, dtype=torch.float64)
    found = photometric_error(a, b, ALPHA)
    assert found.shape == (2, 1, 6, 8)
    assert np.allclose(found[1, 0].numpy(), slow_photometric(a[1].numpy(), b[1].numpy()), atol=1e-12)


def test_photometric_error_is_zero_for_equal_images_and_at_most_one():
    image = noise(1, 3, 8, 8)
    board = (torch.arange(8)[:, None] + torch.arange(8)).remainder(2).float().expand(1, 3, 8, 8)
    assert photometric_error(image, image, ALPHA).max() < 1e-4
    assert photometric_error(board, 1 - board, ALPHA).min() > 0.9
    assert photometric_error(board, 1 - board, ALPHA).max() <= 1


def test_feature_error_is_the_euclidean_distance_over_channels():
    a, b = noise(2, 16, 4, 5, seed=1, dtype=torch.float64), noise(2, 16, 4, 5, seed=2, dtype=torch.float64)
    expected = np.linalg.norm((a - b).numpy(), axis=1)
    assert np.allclose(feature_error(a, b)[:, 0].numpy(), expected, atol=1e-6)


def test_smoothness_equals_the_slow_definition_on_mean_normalised_disparity():
    disparity, image = 0.1 + noise(1, 1, 6, 9, seed=1, dtype=torch.float64), noise(1, 3, 6, 9, seed=2, dtype=torch.float64)
    assert smoothness(disparity, image).item() == pytest.approx(slow_smoothness(disparity[0, 0].numpy(), image[0].numpy()), abs=1e-12)


def test_smoothness_normalises_each_image_by_its_own_mean():
    near, far = 0.1 + noise(1, 1, 6, 9, seed=1), 0.1 + noise(1, 1, 6, 9, seed=2)
    image = noise(1, 3, 6, 9, seed=3)
    together = smoothness(torch.cat([near * 50, far]), image.expand(2, 3, 6, 9))
    assert together.item() == pytest.approx((smoothness(near, image) + smoothness(far, image)).item() / 2, rel=1e-5)


def test_a_depth_edge_costs_less_on_an_image_edge():
    disparity = torch.ones(1, 1, 6, 8)
    disparity[..., 4:] = 2
    flat, edge = torch.zeros(1, 3, 6, 8), torch.zeros(1, 3, 6, 8)
    edge[..., 4:] = 1
    assert (smoothness(disparity, edge) / smoothness(disparity, flat)).item() == pytest.approx(np.exp(-1), rel=1e-5)
    assert smoothness(torch.full((1, 1, 6, 8), 3.0), edge) == 0


def test_the_minimum_over_sources_equals_a_slow_reference():
    errors, valid = noise(1, 3, 5, 6, seed=1, dtype=torch.float64), noise(1, 3, 5, 6, seed=2) > 0.6
    assert not valid.any(dim=1).all()
    assert mean_of_minimum(errors, valid).item() == pytest.approx(slow_minimum(errors[0].numpy(), valid[0].numpy()), abs=1e-12)


def test_a_source_that_does_not_see_a_pixel_cannot_win_there():
    errors = torch.tensor([[0.9, 0.1]]).reshape(1, 2, 1, 1)
    assert mean_of_minimum(errors, torch.tensor([True, False]).reshape(1, 2, 1, 1)).item() == pytest.approx(0.9)


def test_a_pixel_without_a_valid_source_contributes_nothing():
    errors = noise(1, 2, 4, 4).requires_grad_()
    valid = torch.ones(1, 2, 4, 4, dtype=torch.bool)
    valid[..., 1, 2] = False
    loss = mean_of_minimum(errors, valid)
    loss.backward()
    with torch.no_grad():
        changed = errors.clone()
        changed[..., 1, 2] = 1e6
    assert mean_of_minimum(changed, valid) == loss
    assert (errors.grad[..., 1, 2] == 0).all()
    assert errors.grad.sum().item() == pytest.approx(1)  # a mean over the 15 others


def test_without_any_valid_source_the_loss_is_zero_with_zero_gradient():
    errors = noise(1, 2, 4, 4).requires_grad_()
    loss = mean_of_minimum(errors, torch.zeros(1, 2, 4, 4, dtype=torch.bool))
    loss.backward()
    assert loss == 0
    assert (errors.grad == 0).all()


@pytest.mark.parametrize(
    "piece",
    [
        lambda a, b: ssim(a, b),
        lambda a, b: photometric_error(a, b, ALPHA),
        lambda a, b: feature_error(a, b),
        lambda a, b: smoothness(0.2 + a[:, :1], b),
        lambda a, b: mean_of_minimum(torch.cat([a, b], 1), torch.cat([a > 0.3, b > 0.3], 1).detach()),
    ],
    ids=["ssim", "photometric", "feature", "smoothness", "minimum"],
)
def test_gradients_of_the_pieces_equal_finite_differences(piece):
    a, b = noise(1, 3, 4, 5, seed=5, dtype=torch.float64), noise(1, 3, 4, 5, seed=6, dtype=torch.float64)
    assert torch.autograd.gradcheck(piece, (a.requires_grad_(), b.requires_grad_()))


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


def test_scaling_all_disparities_changes_nothing():
    given = batch()
    scaled = given | {"disparities": [7 * d for d in given["disparities"]]}
    assert total_loss(**scaled).total.item() == pytest.approx(total_loss(**given).total.item(), rel=1e-5)


def test_mean_disparity_and_translation_trade_against_each_other():
    given = batch()
    poses = given["poses"].clone()
    poses[..., :3] *= 10
    other = given | {"settings": settings(mean_disparity=1.0), "poses": poses}
    assert total_loss(**other).photometric.item() == pytest.approx(total_loss(**given).photometric.item(), rel=1e-4)


def test_the_weights_act_linearly():
    given = batch()
    parts = [total_loss(**given | {"settings": settings(*w)}).total.item() for w in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))]
    mixed = total_loss(**given | {"settings": settings(2.0, 0.5, 3.0)})
    assert mixed.total.item() == pytest.approx(2 * parts[0] + 0.5 * parts[1] + 3 * parts[2], rel=1e-5)
    assert [mixed.photometric.item(), mixed.smoothness.item(), mixed.feature.item()] == pytest.approx(parts, rel=1e-5)


def test_smoothness_counts_half_at_each_coarser_scale():
    given = batch()
    flat = torch.ones_like(given["disparities"][0])
    fine = total_loss(**given | {"disparities": [given["disparities"][0]]}).smoothness
    coarse = total_loss(**given | {"disparities": [flat, given["disparities"][1]]}).smoothness
    small = torch.nn.functional.avg_pool2d(given["images"][:, 0], 2)
    assert fine.item() == pytest.approx(smoothness(given["disparities"][0], given["images"][:, 0]).item(), rel=1e-5)
    assert coarse.item() == pytest.approx(smoothness(given["disparities"][1], small).item() / 2 / 2, rel=1e-5)


def test_without_features_there_is_no_feature_loss():
    given = batch()
    found = total_loss(**given | {"features": None})
    assert found.feature == 0
    assert found.photometric.item() == total_loss(**given).photometric.item()


def test_the_right_motion_costs_less_than_none():
    rng = torch.Generator().manual_seed(0)
    texture = torch.nn.functional.interpolate(torch.rand(1, 3, 6, 14, generator=rng), (24, 56), mode="bilinear")
    shift = 3
    views = [texture[..., 8 + s : 8 + s + 32] for s in (0, -shift, shift)]  # the world moves right, then left
    k = torch.tensor([[[20.0, 0, 15.5], [0, 20, 11.5], [0, 0, 1]]])
    given = {"images": torch.stack(views, 1), "intrinsics": k, "disparities": [torch.full((1, 1, 24, 32), 4.0)]}
    photometric = settings(1.0, 0.0, 0.0)
    poses = torch.zeros(1, 2, 6)
    poses[0, 0, 0], poses[0, 1, 0] = shift / 20 / 10, -shift / 20 / 10  # pixels / focal length × depth
    assert total_loss(**given, poses=poses, settings=photometric).photometric < 1e-3
    assert total_loss(**given, poses=torch.zeros(1, 2, 6), settings=photometric).photometric > 0.02


def test_where_one_source_is_blind_the_other_one_counts():
    given = batch()
    poses = given["poses"].clone()
    poses[:, 1, 2] = -100  # the second source has passed everything
    alone = given | {"images": given["images"][:, :2], "poses": poses[:, :1], "features": None}
    found = total_loss(**given | {"poses": poses, "features": None}).photometric.item()
    assert found == pytest.approx(total_loss(**alone).photometric.item(), rel=1e-6)


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


# Degenerate input: training must survive it.

CASES = {
    "no motion": lambda g: g | {"poses": torch.zeros_like(g["poses"])},
    "black images": lambda g: g | {"images": torch.zeros_like(g["images"])},
    "white images": lambda g: g | {"images": torch.ones_like(g["images"])},
    "equal images": lambda g: g | {"images": g["images"][:, :1].expand(-1, 3, -1, -1, -1), "poses": torch.zeros_like(g["poses"])},
    "constant features": lambda g: g | {"features": tuple(torch.full_like(f, 0.3) for f in g["features"])},
    "smallest disparity": lambda g: g | {"disparities": [torch.full_like(d, 0.01) for d in g["disparities"]]},
    "both bounds": lambda g: g | {"disparities": [torch.where(d > 1, 10.01, 0.01) for d in g["disparities"]]},
    "behind the camera": lambda g: g | {"poses": g["poses"] - 5},
    "half a turn": lambda g: g | {"poses": g["poses"] + torch.pi},
}


@pytest.mark.parametrize("automask", [False, True])
@pytest.mark.parametrize("case", CASES)
def test_degenerate_input_gives_a_finite_loss_and_finite_gradients(case, automask):
    made, given = leaves(CASES[case](batch()))
    found = total_loss(**given | {"settings": AUTOMASK if automask else given["settings"]})
    found.total.backward()
    assert found.total.isfinite()
    assert all(tensor.grad is None or tensor.grad.isfinite().all() for tensor in made)


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
