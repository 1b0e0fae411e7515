"""Windows that show what they should, laser depth between its points, and figures that can be drawn and saved."""

import numpy as np
import pytest

from dualdepth.evaluation.parts import POLE
from dualdepth.tables.figures import around, boundary_window, far_window, interpolated, pole_window
from dualdepth.tables.plots import map_rows


def holds(window, row, column):
    return all(part.start <= place < part.stop for part, place in zip(window, (row, column)))


@pytest.mark.parametrize("shape", [(375, 1242), (200, 640), (60, 70), (9, 12), (100, 20)])
@pytest.mark.parametrize("share", [0.3, 0.5, 1.0])
def test_a_window_stays_inside_the_image_whatever_its_centre(shape, share):
    image = np.zeros((*shape, 3))
    for row in (-50, 0, 0.4, shape[0] / 2, shape[0] - 1, shape[0] + 50):
        for column in (-50, 0, 0.4, shape[1] / 2, shape[1] - 1, shape[1] + 50):
            window = around(row, column, shape, share)
            assert min(part.start for part in window) >= 0
            assert image[window].shape == (*(part.stop - part.start for part in window), 3)
            inside = np.clip(row, 0, shape[0] - 1), np.clip(column, 0, shape[1] - 1)
            assert holds(window, *inside)


def test_a_window_is_centred_where_there_is_room_and_twice_as_wide_as_high():
    assert around(100, 300, (200, 640), 0.3) == np.s_[70:130, 240:360]
    assert around(0, 639, (200, 640), 0.3) == np.s_[0:60, 520:640]
    assert around(100, 300, (200, 640), 0.5) == np.s_[50:150, 200:400]


def test_the_boundary_window_takes_ratios_not_metres_and_prefers_many_edges_to_a_huge_one():
    depth = np.full((200, 640), 40.0)
    depth[20:50, 20:25] = 79.5  # a step of 39.5 m, not twice as far
    depth[120:150, 500:505] = 1  # a step of 39 m, forty times as near
    assert holds(boundary_window(depth), 135, 502)
    depth[20:50, 20:36:4] = 20
    assert holds(boundary_window(depth), 35, 30)


def test_the_border_to_unknown_depth_is_no_boundary():
    depth = np.full((200, 640), 30.0)
    depth[:60, ::2] = 0
    depth[150:170, 300:310] = 15
    window = boundary_window(depth)
    assert holds(window, 160, 305) and abs(window[1].start + window[1].stop - 610) <= 2


def test_the_far_window_is_where_the_far_points_are():
    truth = np.zeros((200, 640))
    truth[::3, ::3] = 12
    truth[80:90, 400:420] = 35
    truth[150, 10] = 20  # not beyond 20 m
    assert holds(far_window(truth), 85, 410)
    assert far_window(truth) == around(84.5, 409.5, truth.shape)
    assert far_window(np.full((200, 640), 20.0)) is None


def test_the_pole_window_is_around_the_largest_pole_of_20_pixels_or_more():
    labels = np.zeros((200, 640), np.uint8)
    labels[60:140, 300:304] = POLE
    labels[20:60, 30:34] = POLE
    labels[:, 500:600] = 8  # something larger that is no pole
    window = pole_window(labels)
    assert window == around(99.5, 301.5, labels.shape, 0.5)
    assert holds(window, 60, 300) and holds(window, 139, 303)
    for height in (0, 4, 5):
        labels = np.zeros((200, 640), np.uint8)
        labels[100 : 100 + height, 300:304] = POLE
        assert (pole_window(labels) is not None) == (height == 5)


def test_between_the_points_inverse_depth_is_linear():
    rows, columns = np.mgrid[:41, :61]
    inverse = 0.02 + 0.003 * rows + 0.001 * columns
    sparse = np.zeros((41, 61))
    sparse[::10, ::10] = 1 / inverse[::10, ::10]
    np.testing.assert_allclose(interpolated(sparse), 1 / inverse, rtol=1e-6)


def test_above_the_highest_point_nothing_is_made_up():
    sparse = np.zeros((40, 60))
    sparse[15::8, ::59] = 10.0
    depth = interpolated(sparse)
    assert (depth[:15] == 0).all()
    np.testing.assert_allclose(depth[16:39, 1:-1], 10)


@pytest.mark.parametrize("places", [([3, 10], [4, 20]), (5, slice(None, None, 3))], ids=["too few", "on one line"])
def test_points_that_span_no_triangle_stay_as_they_are(places):
    sparse = np.zeros((20, 30))
    sparse[places] = 12
    np.testing.assert_array_equal(interpolated(sparse), sparse)


RNG = np.random.default_rng(0)
IMAGES = [RNG.integers(0, 255, (48, 96, 3), dtype=np.uint8) for _ in range(2)]
DEPTHS = [RNG.uniform(2, 90, (48, 96)) * (RNG.random((48, 96)) < 0.8) for _ in range(2)]
SPARSE = [depth * (RNG.random((48, 96)) < 0.1) for depth in DEPTHS]
ERRORS = [np.where(sparse > 0, 0.2, np.nan) for sparse in SPARSE]
WINDOWS = [around(10, 10, (48, 96)), around(40, 80, (48, 96))]
TITLES = ["one", "two"]


@pytest.mark.parametrize(("errors", "maps", "unknown"), [((), DEPTHS, 0), (["lr"], ERRORS, np.nan)])
def test_close_ups_show_the_windows_of_the_image_and_of_its_map(errors, maps, unknown):
    figure = map_rows(IMAGES, {"lr": maps}, TITLES, windows=WINDOWS, errors=errors)
    shown = [axes.images[0].get_array() for axes in figure.axes if axes.get_label() != "<colorbar>"]
    for number, window in enumerate(WINDOWS):
        np.testing.assert_array_equal(shown[2 * number], IMAGES[number][window])
        np.testing.assert_array_equal(np.ma.filled(shown[2 * number + 1], unknown), maps[number][window])
