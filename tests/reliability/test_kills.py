"""A training that is killed at random moments ends as the one that never was; the soak does this for longer."""

import pytest

from tests.reliability.kills import try_kills

pytestmark = pytest.mark.slow


def test_killed_trainings_of_both_stages_end_with_the_same_weights(tmp_path):
    six = {"batch_size": 2, "epochs": 2, "max_steps": 6}
    tallies = try_kills(tmp_path, kills=3, each=2, seed=6, lr=six, hr=six)  # draws both kinds of moments
    assert all(tally.identical for tally in tallies)
    assert len(tallies) >= 2  # both stages
    assert sum(tally.while_writing for tally in tallies) > 0
