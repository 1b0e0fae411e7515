"""Random scale and crop: what the camera matrix says must be what the picture shows."""

import cv2
import numpy as np
import pytest

from dualdepth.data.frames import resample
from dualdepth.data.loading import augment, crop_frame, crop_intrinsics, draw_crop, full_crop
from dualdepth.settings import Augmentation

RAW = (100, 330)
K = np.array([[190.0, 0, 171.3], [0, 205.0, 46.8], [0, 0, 1]])


def project(matrix, point):
    u, v, w = matrix @ point
    return np.array([u / w, v / w])


def picture_of(point, size=RAW, matrix=K, spread=4.0):
    """A bright blob where the camera sees a 3-D point, on black."""
    u, v = project(matrix, point)
    rows, columns = np.mgrid[: size[0], : size[1]]
    blob = 250 * np.exp(-((columns - u) ** 2 + (rows - v) ** 2) / (2 * spread**2))
    return np.repeat(np.rint(blob).astype(np.uint8)[..., None], 3, axis=2)


def centre_of_blob(image):
    grey = image[..., 0].astype(float)
    rows, columns = np.mgrid[: grey.shape[0], : grey.shape[1]]
    return np.array([(columns * grey).sum(), (rows * grey).sum()]) / grey.sum()


@pytest.mark.parametrize("flip", [False, True])
@pytest.mark.parametrize("augment_first", [True, False])
@pytest.mark.parametrize("size", [(96, 288), (192, 576), (96, 384)], ids=["shrunk", "enlarged", "mixed"])
def test_a_point_in_space_stays_on_its_picture(size, augment_first, flip):
    settings = Augmentation(augment_first=augment_first, beyond_paper_flip=flip)
    mirrored = 0
    for seed in range(8):
        rng = np.random.default_rng(seed)
        point = np.array([*rng.uniform(-0.25, 0.25, 2) * [2, 0.6], 1.0]) * rng.uniform(2, 60)
        raw = picture_of(point)
        images, matrix = augment([raw, raw], K, size, settings, np.random.default_rng(seed))
        shown = size if augment_first else (size[0] // 3, size[1] // 3)
        assert images.shape == (2, *shown, 3)
        # a mirrored picture is that of a mirrored world
        expected = [project(matrix, point), project(matrix, point * [-1, 1, 1])]
        misses = [np.abs(centre_of_blob(images[0]) - place).max() for place in expected]
        mirrored += flip and misses[1] < misses[0]
        assert (min(misses) if flip else misses[0]) < 0.1
    assert mirrored in (range(1, 8) if flip else [0])


def test_ignoring_the_crop_would_be_noticed():
    point = np.array([1.0, 0.2, 8.0])
    images, _ = augment([picture_of(point)], K, (96, 288), Augmentation(), np.random.default_rng(3))
    untouched = crop_intrinsics(K, full_crop(RAW), (96, 288))
    assert np.abs(centre_of_blob(images[0]) - project(untouched, point)).max() > 1


def test_windows_show_between_all_and_1_over_max_scale_of_the_frame_in_each_direction():
    rng = np.random.default_rng(0)
    windows = [draw_crop((375, 1242), Augmentation(max_scale=1.15), rng) for _ in range(300)]
    widths, heights = np.array([w.width for w in windows]), np.array([w.height for w in windows])
    assert 1242 / 1.15 - 0.5 <= widths.min() < 1242 / 1.14
    assert 1242 / 1.01 < widths.max() <= 1242
    assert 375 / 1.15 - 0.5 <= heights.min() < 375 / 1.14
    assert 375 / 1.01 < heights.max() <= 375
    assert abs(np.corrcoef(widths, heights)[0, 1]) < 0.2  # x and y are drawn independently
    assert all(0 <= w.left <= 1242 - w.width and 0 <= w.top <= 375 - w.height for w in windows)
    assert len({w.left for w in windows}) > 30
    assert not any(w.flip for w in windows)


def test_without_enlargement_the_whole_frame_is_shown():
    frame = np.random.default_rng(0).integers(0, 256, (*RAW, 3), np.uint8)
    images, matrix = augment([frame], K, (96, 288), Augmentation(max_scale=1.0), np.random.default_rng(5))
    assert np.array_equal(images[0], cv2.resize(frame, (288, 96), interpolation=cv2.INTER_AREA))
    assert np.allclose(matrix[0], [190 * 288 / 330, 0, (171.3 + 0.5) * 288 / 330 - 0.5])
    assert np.allclose(matrix[1], [0, 205 * 0.96, (46.8 + 0.5) * 0.96 - 0.5])


def test_the_frames_of_a_triplet_are_shown_through_one_window():
    frame = np.random.default_rng(0).integers(0, 256, (*RAW, 3), np.uint8)
    images, _ = augment([frame, frame, frame], K, (96, 288), Augmentation(beyond_paper_flip=True), np.random.default_rng(1))
    assert np.array_equal(images[0], images[1])
    assert np.array_equal(images[0], images[2])


def test_the_draw_is_fixed_by_the_generator():
    frame = np.random.default_rng(0).integers(0, 256, (*RAW, 3), np.uint8)
    first, second, other = (augment([frame], K, (96, 288), Augmentation(), np.random.default_rng(s)) for s in (1, 1, 2))
    assert np.array_equal(first[0], second[0])
    assert np.array_equal(first[1], second[1])
    assert not np.array_equal(first[1], other[1])


def test_shrinking_averages_instead_of_skipping_pixels():
    stripes = np.zeros((12, 36, 3), np.uint8)
    stripes[:, ::3] = 240
    assert (resample(stripes, (4, 12)) == 80).all()


def test_mirroring_mirrors_the_picture():
    frame = np.random.default_rng(0).integers(0, 256, (*RAW, 3), np.uint8)
    window = full_crop(RAW)
    assert np.array_equal(crop_frame(frame, window._replace(flip=True), RAW), frame[:, ::-1])
