"""Near and far pixels, and regions of label maps, against a slow reference and closed forms."""

import cv2
import numpy as np
import pytest
from slow_metrics import slow_metrics

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import evaluate_parts
from dualdepth.evaluation.parts import in_regions, near_and_far, pole_errors

NEAR, FAR = "<= 20 m", "> 20 m"
ROAD, GREEN = "Road", "Tree & grass"
LIMITS = {"min_depth": 2.0, "max_depth": 60.0}


def slow_parts(prediction, truth, kind, own_ratio, inside):
    """Metrics of an image's parts without a crop; `inside` says of each part whether it has a pixel. The resize alone is OpenCV's."""
    height, width = truth.shape
    depth = cv2.resize(prediction if kind == "depth" else 1 / prediction, (width, height))
    places = [(r, c) for r in range(height) for c in range(width) if 2 < truth[r, c] < 60]
    scores = {}
    for name, has in inside.items():
        part = [place for place in places if has(place)]
        scaled_by = part if own_ratio else places
        ratio = np.median([truth[p] for p in scaled_by]) / np.median([depth[p] for p in scaled_by])
        scores[name] = slow_metrics([(float(truth[p]), min(max(float(depth[p]) * ratio, 2.0), 60.0)) for p in part])
    return scores


def sample(seed, size=(23, 31)):
    """A random prediction, a sparse truth on both sides of 20 m with some pixels at exactly that, and labels of every id."""
    rng = np.random.default_rng(seed)
    truth = np.where(rng.random(size) < 0.5, rng.uniform(0.5, 70, size), 0).astype(np.float32)
    truth[rng.random(size) < 0.05] = 20
    labels = rng.choice(np.array([*range(19), 255], np.uint8), size)
    return rng.uniform(0.02, 3, (8, 11)).astype(np.float32), truth, labels


def evaluate_regions(predictions, truths, labels, **protocol):
    parts = in_regions(labels.__getitem__, [f"{number}.png" for number in range(len(labels))])
    return evaluate_parts(predictions, truths, parts, required="a pixel of a region", **protocol)


@pytest.mark.parametrize("kind", ["depth", "disparity"])
@pytest.mark.parametrize("own_ratio", [False, True])
@pytest.mark.parametrize("by", ["distance", "region"])
def test_both_parts_equal_the_slow_reference(kind, own_ratio, by):
    samples = [sample(seed) for seed in range(3)]
    predictions, truths, labels = zip(*samples)
    parts = near_and_far if by == "distance" else in_regions(labels.__getitem__, labels)
    frame = evaluate_parts(predictions, truths, parts, own_ratio=own_ratio, kind=kind, crop="none", **LIMITS)
    assert frame.index.names == ["image", "part"]
    for image, (prediction, truth, ids) in enumerate(samples):
        distances = {NEAR: lambda p, t=truth: t[p] <= 20, FAR: lambda p, t=truth: t[p] > 20}
        regions = {ROAD: lambda p, i=ids: i[p] == 0, GREEN: lambda p, i=ids: i[p] in (8, 9)}
        expected = slow_parts(prediction, truth, kind, own_ratio, distances if by == "distance" else regions)
        assert list(frame.loc[image].index) == list(expected)
        for part, values in expected.items():
            assert frame.loc[(image, part), list(values)].to_dict() == pytest.approx(values, rel=1e-5), (image, part)


def test_images_without_a_pixel_of_a_part_have_no_row_for_it():
    near, none, far = np.full((20, 30), 8.0), np.zeros((20, 30)), np.full((20, 30), 33.0)
    frame = evaluate_parts([np.ones((4, 6))] * 4, [near, none, far, np.hstack([near, far])], near_and_far)
    assert list(frame.index) == [(0, NEAR), (2, FAR), (3, NEAR), (3, FAR)]
    truth = np.full((1, 8), 10.0)
    labels = [np.array([row], np.uint8) for row in ([0] * 5 + [8] * 3, [2] * 8, [0] + [2] * 7)]
    assert list(evaluate_regions([truth] * 3, [truth] * 3, labels, crop="none").index) == [(0, ROAD), (0, GREEN), (2, ROAD)]


def test_label_maps_of_another_size_and_images_without_a_region_are_refused():
    depth, labels = np.full((20, 40), 10.0), np.zeros((20, 40), np.uint8)
    with pytest.raises(InputError, match="png: the label map is of 20x39 pixels, the ground truth of 20x40"):
        evaluate_regions([depth] * 2, [depth] * 2, [labels, labels[:, 1:]])
    with pytest.raises(InputError, match="none of the 1 ground truths has a pixel of a region"):
        evaluate_regions([depth], [depth], [labels + 2])


def test_only_pixels_of_poles_with_truth_in_range_count():
    labels = np.array([[5, 5, 5, 5, 5, 7, 8]], np.uint8)
    truth = np.array([[10, 20, 0, 80, 100, 10, 10]], np.float32)  # two poles in range; none known; at the limit; beyond it
    depth = np.array([[12, 15, 9, 9, 9, 99, 50]], np.float32)
    found = pole_errors(depth, truth, labels, max_depth=80)
    assert found["valid_pixels"] == 2
    assert found["abs_rel"] == pytest.approx((2 / 10 + 5 / 20) / 2)
    assert found["rmse"] == pytest.approx(np.sqrt((4 + 25) / 2)) and found["a1"] == 0.5
    assert pole_errors(depth, truth, labels + 10, max_depth=80) is None
