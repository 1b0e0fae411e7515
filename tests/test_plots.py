"""Pictures of errors at laser points."""

import numpy as np
import pytest

from dualdepth.plots import point_errors


def test_a_point_shows_its_error_in_a_disc_around_it_and_nothing_beyond():
    truth = np.zeros((15, 21))
    truth[7, 10] = 10
    prediction = np.full(truth.shape, 3.0)
    prediction[7, 10] = 12.5
    rows, columns = np.mgrid[:15, :21]
    near = np.hypot(rows - 7, columns - 10) <= 2.5
    error = point_errors(prediction, truth)
    np.testing.assert_allclose(error[near], 0.25)
    assert near.sum() == 21 and np.isnan(error[~near]).all()


@pytest.mark.parametrize("step", [(0, 2), (2, 0), (0, 1), (1, 1)])
def test_a_points_error_is_not_hidden_by_its_neighbours(step):
    truth, prediction = np.zeros((11, 11)), np.zeros((11, 11))
    wrong, right = (5, 5), (5 + step[0], 5 + step[1])
    truth[wrong], prediction[wrong] = 4, 8
    truth[right], prediction[right] = 40, 40  # farther or nearer, it is the place that counts
    error = point_errors(prediction, truth)
    assert error[wrong] == pytest.approx(1) and error[right] == 0
    assert error[5 - step[0], 5 - step[1]] == pytest.approx(1)


def test_a_pixel_shows_the_nearest_of_several_points():
    rng = np.random.default_rng(0)
    truth = rng.uniform(5, 50, (30, 40)) * (rng.random((30, 40)) < 0.03)
    prediction = rng.uniform(5, 50, (30, 40))
    error, places = point_errors(prediction, truth), np.argwhere(truth > 0)
    known = 0
    for row, column in np.ndindex(truth.shape):
        away = np.hypot(*(places - (row, column)).T)
        if away.min() > 2.5:
            assert np.isnan(error[row, column])
            continue
        # of points equally far, any may be shown
        allowed = [abs(prediction[r, c] - truth[r, c]) / truth[r, c] for r, c in places[np.isclose(away, away.min())]]
        assert np.isclose(error[row, column], allowed).any()
        known += 1
    assert 100 < known < truth.size
