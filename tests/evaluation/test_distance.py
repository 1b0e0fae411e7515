"""Near and far pixels against a slow reference and closed forms."""

import cv2
import numpy as np
import pytest
from slow_metrics import slow_metrics

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import METRICS, evaluate, evaluate_parts
from dualdepth.evaluation.distance import near_and_far

NEAR, FAR = "<= 20 m", "> 20 m"


def slow_parts(prediction, truth, kind, own_ratio, min_depth, max_depth):
    """Metrics of both parts of an image without a crop; the resize alone is OpenCV's, which the protocol names."""
    height, width = truth.shape
    depth = cv2.resize(prediction if kind == "depth" else 1 / prediction, (width, height))
    places = [(r, c) for r in range(height) for c in range(width) if min_depth < truth[r, c] < max_depth]
    pairs = [(float(truth[place]), float(depth[place])) for place in places]
    parts = {NEAR: [(g, p) for g, p in pairs if g <= 20], FAR: [(g, p) for g, p in pairs if g > 20]}
    scores = {}
    for name, part in parts.items():
        scaled_by = part if own_ratio else pairs
        ratio = np.median([g for g, _ in scaled_by]) / np.median([p for _, p in scaled_by])
        scores[name] = slow_metrics([(g, min(max(p * ratio, min_depth), max_depth)) for g, p in part])
    return scores


def sample(seed, size=(23, 31)):
    """A random prediction, and a sparse truth on both sides of 20 m with some pixels at exactly that."""
    rng = np.random.default_rng(seed)
    truth = np.where(rng.random(size) < 0.5, rng.uniform(0.5, 70, size), 0).astype(np.float32)
    truth[rng.random(size) < 0.05] = 20
    return rng.uniform(0.02, 3, (8, 11)).astype(np.float32), truth


@pytest.mark.parametrize("kind", ["depth", "disparity"])
@pytest.mark.parametrize("own_ratio", [False, True])
def test_both_parts_equal_the_slow_reference(kind, own_ratio):
    pairs = [sample(seed) for seed in range(3)]
    settings = {"min_depth": 2.0, "max_depth": 60.0}
    frame = evaluate_parts(*zip(*pairs), near_and_far, own_ratio=own_ratio, kind=kind, crop="none", **settings)
    assert list(frame.index) == [(image, part) for image in range(3) for part in (NEAR, FAR)]
    assert frame.index.names == ["image", "part"]
    for image, (prediction, truth) in enumerate(pairs):
        for part, expected in slow_parts(prediction, truth, kind, own_ratio, **settings).items():
            for name, value in expected.items():
                assert frame.loc[(image, part), name] == pytest.approx(value, rel=1e-5), (image, part, name)


def test_exactly_20_m_is_near_and_the_next_number_is_far():
    above = np.nextafter(np.float32(20), np.float32(21))
    truth = np.array([[10, 20, 20, above]], np.float32)
    frame = evaluate_parts([truth], [truth], near_and_far, crop="none")
    assert frame["valid_pixels"].to_dict() == {(0, NEAR): 3, (0, FAR): 1}


def test_the_truth_says_which_part_a_pixel_belongs_to():
    truth = np.array([[10.0, 10, 10, 19, 30]])
    prediction = np.array([[10.0, 10, 10, 38, 15]])
    frame = evaluate_parts([prediction], [truth], near_and_far, crop="none")
    assert frame["valid_pixels"].tolist() == [4, 1]
    assert frame["abs_rel"].tolist() == pytest.approx([1 / 4, 0.5])


def test_an_image_has_one_ratio_unless_each_part_is_given_its_own():
    truth = np.array([[10.0, 10, 10, 40, 40]])
    prediction = np.array([[1.0, 1, 1, 2, 2]])  # times ten the near part is exact, the far part half of what it should be
    one = evaluate_parts([prediction], [truth], near_and_far, crop="none")
    assert one["abs_rel"].to_dict() == pytest.approx({(0, NEAR): 0, (0, FAR): 0.5})
    own = evaluate_parts([prediction], [truth], near_and_far, crop="none", own_ratio=True)
    assert own["abs_rel"].tolist() == pytest.approx([0, 0])


def test_a_parts_own_ratio_is_of_what_was_predicted_before_any_clamp():
    truth = np.array([[10.0] * 5 + [30, 40, 50]])
    prediction = np.array([[1.0] * 5 + [30, 40, 50]])  # at the image's ratio of ten the far part would be 80 throughout
    own = evaluate_parts([prediction], [truth], near_and_far, crop="none", own_ratio=True)
    np.testing.assert_allclose(own["abs_rel"], 0, atol=1e-12)
    one = evaluate_parts([prediction], [truth], near_and_far, crop="none")
    assert one.loc[(0, FAR), "abs_rel"] == pytest.approx((50 / 30 + 1 + 30 / 50) / 3)


def test_a_part_is_clamped_after_its_own_scaling():
    truth = np.array([[10.0] * 5 + [30, 40, 50]])
    prediction = np.array([[1.0] * 4 + [1e-6] + [3, 4, 5000]])
    own = evaluate_parts([prediction], [truth], near_and_far, crop="none", own_ratio=True, min_depth=5)
    assert own.loc[(0, FAR), "abs_rel"] == pytest.approx(30 / 50 / 3)
    assert own.loc[(0, NEAR), "abs_rel"] == pytest.approx(5 / 10 / 5)


@pytest.mark.parametrize("own_ratio", [False, True])
def test_a_perfect_prediction_scores_zeros_and_ones_in_both_parts(own_ratio):
    truth = np.random.default_rng(0).uniform(1, 79, (40, 60))
    frame = evaluate_parts([truth], [truth], near_and_far, own_ratio=own_ratio)
    np.testing.assert_allclose(frame[list(METRICS)], [[0, 0, 0, 0, 1, 1, 1]] * 2, atol=1e-12)


def test_only_the_parts_that_an_image_has_get_a_row():
    near, none, far = np.full((20, 30), 8.0), np.zeros((20, 30)), np.full((20, 30), 33.0)
    frame = evaluate_parts([np.ones((4, 6))] * 4, [near, none, far, np.hstack([near, far])], near_and_far)
    assert list(frame.index) == [(0, NEAR), (2, FAR), (3, NEAR), (3, FAR)]


def test_the_parts_together_are_the_pixels_of_the_protocol():
    pairs = [sample(seed, (40, 60)) for seed in range(2)]
    predictions, truths = [p for p, _ in pairs], [g for _, g in pairs]
    whole = evaluate(predictions, truths, kind="disparity", crop="garg", max_depth=50)
    parts = evaluate_parts(predictions, truths, near_and_far, kind="disparity", crop="garg", max_depth=50)
    pixels = parts["valid_pixels"]
    assert pixels.groupby("image").sum().tolist() == whole["valid_pixels"].tolist()
    mixed = (parts["abs_rel"] * pixels).groupby("image").sum() / pixels.groupby("image").sum()
    np.testing.assert_allclose(mixed, whole["abs_rel"])


def test_an_empty_or_unequal_input_is_one_clear_error():
    depth = np.full((20, 40), 10.0)
    with pytest.raises(InputError, match="none of the 1 ground truths has a valid pixel"):
        evaluate_parts([depth], [np.zeros_like(depth)], near_and_far)
    with pytest.raises(InputError, match="holds 2 predictions but there are 1 ground truths"):
        evaluate_parts([depth, depth], [depth], near_and_far)
    with pytest.raises(InputError, match="image 1: the depth goes from nan"):
        evaluate_parts([depth, np.full_like(depth, np.nan)], [depth, depth], near_and_far)
