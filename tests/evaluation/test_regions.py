"""Regions against a slow reference and closed forms."""

import cv2
import numpy as np
import pytest
from slow_metrics import slow_metrics

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import evaluate_parts
from dualdepth.evaluation.regions import POLE, REGIONS, class_errors, in_regions

ROAD, GREEN = "Road", "Tree & grass"


def slow_regions(prediction, truth, labels, kind, min_depth, max_depth):
    """Metrics of an image's regions without a crop; the resize alone is OpenCV's, which the protocol names."""
    height, width = truth.shape
    depth = cv2.resize(prediction if kind == "depth" else 1 / prediction, (width, height))
    places = [(r, c) for r in range(height) for c in range(width) if min_depth < truth[r, c] < max_depth]
    ratio = np.median([truth[place] for place in places]) / np.median([depth[place] for place in places])
    inside = {ROAD: [place for place in places if labels[place] == 0], GREEN: [place for place in places if labels[place] in (8, 9)]}
    return {
        name: slow_metrics([(float(truth[place]), min(max(float(depth[place]) * ratio, min_depth), max_depth)) for place in chosen])
        for name, chosen in inside.items()
    }


def evaluate_regions(predictions, truths, labels, **protocol):
    parts = in_regions(labels, [f"{number}.png" for number in range(len(labels))])
    return evaluate_parts(predictions, truths, parts, required="a pixel of a region", **protocol)


def sample(seed, size=(23, 31)):
    """A random prediction, a sparse truth, and labels of all kinds."""
    rng = np.random.default_rng(seed)
    truth = np.where(rng.random(size) < 0.5, rng.uniform(0.5, 70, size), 0).astype(np.float32)
    labels = rng.choice(np.array([0, 1, 7, 8, 9, 10, 255], np.uint8), size)
    return rng.uniform(0.02, 3, (8, 11)).astype(np.float32), truth, labels


@pytest.mark.parametrize("kind", ["depth", "disparity"])
def test_both_regions_equal_the_slow_reference(kind):
    samples = [sample(seed) for seed in range(3)]
    settings = {"min_depth": 2.0, "max_depth": 60.0}
    frame = evaluate_regions(*zip(*samples), kind=kind, crop="none", **settings)
    assert list(frame.index) == [(image, region) for image in range(3) for region in (ROAD, GREEN)]
    assert frame.index.names == ["image", "part"]
    for image, given in enumerate(samples):
        for region, expected in slow_regions(*given, kind, **settings).items():
            for name, value in expected.items():
                assert frame.loc[(image, region), name] == pytest.approx(value, rel=1e-5), (image, region, name)


def test_road_is_road_alone_and_green_is_vegetation_and_terrain():
    assert REGIONS == {ROAD: (0,), GREEN: (8, 9)}
    truth = np.full((1, 256), 10.0)
    frame = evaluate_regions([truth], [truth], [np.arange(256, dtype=np.uint8)[None]], crop="none")
    assert frame["valid_pixels"].to_dict() == {(0, ROAD): 1, (0, GREEN): 2}


def test_images_without_a_pixel_of_a_region_have_no_row_for_it():
    truth = np.full((1, 8), 10.0)
    labels = [np.array([row], np.uint8) for row in ([0] * 5 + [8] * 3, [2] * 8, [0] + [2] * 7)]
    assert list(evaluate_regions([truth] * 3, [truth] * 3, labels, crop="none").index) == [(0, ROAD), (0, GREEN), (2, ROAD)]
    unknown = evaluate_regions([truth] * 2, [0 * truth, truth], labels[:1] * 2, crop="none")
    assert list(unknown.index) == [(1, ROAD), (1, GREEN)]  # the others keep their places


def test_bad_input_is_one_clear_error():
    depth, labels = np.full((20, 40), 10.0), np.zeros((20, 40), np.uint8)
    with pytest.raises(InputError, match="png: the label map is of 20x39 pixels, the ground truth of 20x40"):
        evaluate_regions([depth] * 2, [depth] * 2, [labels, labels[:, 1:]])
    with pytest.raises(InputError, match="image 1: the depth goes from nan"):
        evaluate_regions([depth, depth * np.nan], [depth] * 2, [labels] * 2)
    with pytest.raises(InputError, match="none of the 1 ground truths has a pixel of a region"):
        evaluate_regions([depth], [depth], [labels + 2])


def test_only_pixels_of_the_class_with_truth_in_range_count():
    labels = np.array([[5, 7, 5, 5, 5, 0, 8]], np.uint8)
    truth = np.array([[10, 20, 0, 80, 100, 10, 10]], np.float32)  # a pole and a sign in range; none known; at the limit; beyond it
    depth = np.array([[12, 15, 9, 9, 9, 99, 50]], np.float32)
    found = class_errors(depth, truth, labels, [POLE, 7], max_depth=80)
    assert found["valid_pixels"] == 2  # of both classes together
    assert found["abs_rel"] == pytest.approx((2 / 10 + 5 / 20) / 2)
    assert found["rmse"] == pytest.approx(np.sqrt((4 + 25) / 2)) and found["a1"] == 0.5


@pytest.mark.parametrize(("label", "depth"), [(0, 10.0), (5, 0.0), (5, 80.0), (5, 500.0)])
def test_there_is_no_score_where_no_pixel_counts(label, depth):
    maps = np.full((4, 4), depth), np.full((4, 4), label)
    assert class_errors(np.ones((4, 4)), *maps, [POLE], max_depth=80) is None
