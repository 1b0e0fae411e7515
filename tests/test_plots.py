"""Pictures of errors at laser points."""

import numpy as np

from dualdepth.tables.plots import point_errors


def test_a_pixel_shows_the_nearest_of_several_points():
    rng = np.random.default_rng(0)
    truth = rng.uniform(5, 50, (30, 40)) * (rng.random((30, 40)) < 0.03)
    truth[20, [9, 10, 12]] = 4, 40, 20  # beside each other; it is the place that counts
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
