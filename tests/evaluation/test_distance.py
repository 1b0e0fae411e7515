"""Near and far pixels against a slow reference and closed forms."""

import cv2
import numpy as np
import pytest
from slow_metrics import slow_metrics

from dualdepth.evaluation.depth import evaluate, evaluate_parts
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
