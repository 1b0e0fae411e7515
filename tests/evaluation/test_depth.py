"""Depth metrics against a slow reference, closed forms and docs/protocols.md."""

import math

import cv2
import numpy as np
import pytest
from slow_metrics import slow_metrics

from dualdepth.errors import InputError
from dualdepth.evaluation.depth import METRICS, Protocol, crop_box, errors, evaluate, summary, valid_pixels


def slow_scores(prediction, ground_truth, kind, resize, crop, min_depth, max_depth, scaling):
    """The protocol with Python loops over pixels; the resize alone is OpenCV's, which the protocol names."""
    height, width = ground_truth.shape
    values = prediction if kind == resize else 1 / prediction
    values = cv2.resize(values, (width, height))
    shares = {"garg": (0.40810811, 0.99189189), "eigen": (0.3324324, 0.91351351), "none": (0, 1)}[crop]
    sides = (0, 1) if crop == "none" else (0.03594771, 0.96405229)
    pairs = []
    for row in range(int(shares[0] * height), int(shares[1] * height)):
        for column in range(int(sides[0] * width), int(sides[1] * width)):
            if min_depth < ground_truth[row, column] < max_depth:
                value = float(values[row, column])
                pairs.append((float(ground_truth[row, column]), 1 / value if resize == "disparity" else value))
    ratio = np.median([g for g, _ in pairs]) / np.median([p for _, p in pairs]) if scaling else 1.0
    return slow_metrics([(g, min(max(p * ratio, min_depth), max_depth)) for g, p in pairs]) | {"scale_ratio": ratio}


def sample(seed, size=(37, 61), small=(12, 20)):
    rng = np.random.default_rng(seed)
    ground_truth = np.where(rng.random(size) < 0.4, rng.uniform(0.5, 95, size), 0).astype(np.float32)
    return rng.uniform(0.02, 3, small).astype(np.float32), ground_truth


@pytest.mark.parametrize("crop", ["garg", "eigen", "none"])
@pytest.mark.parametrize("kind", ["depth", "disparity"])
@pytest.mark.parametrize("resize", ["depth", "disparity"])
@pytest.mark.parametrize("scaling", [True, False])
def test_equals_the_slow_reference(kind, resize, crop, scaling):
    pairs = [sample(seed) for seed in range(3)]
    settings = {"kind": kind, "resize": resize, "crop": crop, "min_depth": 0.7, "max_depth": 60}
    frame = evaluate(*zip(*pairs), median_scaling=scaling, **settings)
    slow = [slow_scores(p, g, kind, resize, crop, 0.7, 60, scaling) for p, g in pairs]
    for name in (*METRICS, "scale_ratio", "valid_pixels"):
        np.testing.assert_allclose(frame[name], [s[name] for s in slow], rtol=1e-6, err_msg=name)
    means = summary(frame)
    assert means["n"] == 3
    assert means["abs_rel"] == pytest.approx(np.mean([s["abs_rel"] for s in slow]), rel=1e-6)


def test_scale_spread_is_the_deviation_of_the_relative_ratio():
    ground_truth = np.full((4, 4), 10.0)
    values = summary(evaluate([ground_truth / f for f in (1, 2, 4)], [ground_truth] * 3, crop="none"))
    assert values["scale_ratio_median"] == pytest.approx(2)
    assert values["scale_ratio_spread"] == pytest.approx(np.std([0.5, 1, 2]))


@pytest.mark.parametrize(
    "height, width, rows, columns",
    [
        (375, 1242, (153, 371), (44, 1197)),
        (370, 1224, (151, 366), (43, 1180)),
        (374, 1238, (152, 370), (44, 1193)),
        (370, 1226, (151, 366), (44, 1181)),
        (376, 1241, (153, 372), (44, 1196)),
    ],
)
def test_garg_crop_of_the_five_kitti_sizes(height, width, rows, columns):
    assert crop_box("garg", height, width) == (slice(*rows), slice(*columns))
    assert crop_box("none", height, width) == (slice(0, height), slice(0, width))


def test_depth_limits_are_strict():
    limits = np.array([[1e-3, 80.0, 79.9], [0.0, np.nan, 10.0]], np.float32)
    for ground_truth in (limits, limits.astype(np.float64).round(6)):
        pixels = valid_pixels(np.ones((2, 3), np.float32), ground_truth, Protocol(crop="none"))
        assert list(pixels.index) == [2, 5]
    every = valid_pixels(np.ones((2, 3), np.float32), limits * 10, Protocol(crop="none", valid="positive"))
    assert list(every.index) == [0, 1, 2, 5]


def test_accuracy_thresholds_are_strict():
    assert [errors(np.array([10.0]), np.array([8.0]))[f"a{k}"] for k in (1, 2)] == [0, 1]
    assert errors(np.array([8.0]), np.array([10.0]))["a1"] == 0
    assert errors(np.array([1.25**2]), np.array([1.0]))["a2"] == 0


def test_an_image_without_ground_truth_is_skipped_and_counted():
    ground_truth = np.full((20, 20), 10.0)
    frame = evaluate(np.ones((3, 5, 5)), [ground_truth, np.zeros((20, 20)), ground_truth])
    assert list(frame.index) == [0, 2] and not frame.isna().any(axis=None)
    values = summary(frame)
    assert values["n"] == 2 and values["skipped"] == 1
    with pytest.raises(InputError, match="none of the 1 ground truths"):
        evaluate(np.ones((1, 5, 5)), [np.zeros((20, 20))])


def test_disparity_0_is_the_largest_depth_as_in_monodepth2_where_disparity_is_resized():
    disparity, truth = np.full((1, 9, 9), 0.2), np.full((9, 9), 5.0)
    disparity[0, 0, 0], truth[0, 0] = 0, 70
    scores = summary(evaluate(disparity, [truth], kind="disparity", resize="disparity", crop="none"))
    assert scores["rmse"] == pytest.approx(10 / 9) and scores["scale_ratio_median"] == pytest.approx(1)
    for wrong, resize in ((0 * disparity, "disparity"), (disparity, "depth")):
        with pytest.raises(InputError, match=r"P: image 0: the disparity goes from 0 to .*, or 0 in some pixels with --resize disparity"):
            evaluate(wrong, [truth], name="P", kind="disparity", resize=resize)
    disparity[0, 2:] = 0
    with pytest.raises(InputError, match="P: image 0: the disparity is 0 in most"):
        evaluate(disparity, [truth], name="P", kind="disparity", resize="disparity")


@pytest.mark.parametrize("bad, says", [(np.nan, "to nan"), (np.inf, "to inf"), (0.0, "from 0 to"), (-2.0, "from -2 to")])
def test_a_prediction_that_cannot_be_scored_is_named(bad, says):
    predictions = np.ones((3, 5, 5), np.float32)
    predictions[1, 2, 2] = bad
    with pytest.raises(InputError, match=f"P.npy: image 1: .*{says}"):
        evaluate(predictions, [np.full((9, 9), 5.0)] * 3, name="P.npy")


@pytest.mark.parametrize("setting", [{"kind": "metres"}, {"crop": "grag"}, {"min_depth": 0}, {"min_depth": 90}, {"max_depth": math.inf}])
def test_bad_settings_are_refused(setting):
    with pytest.raises(InputError, match=next(iter(setting))):
        Protocol(**setting)
