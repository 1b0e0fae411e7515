"""A training that is killed at random moments ends as the one that never was; the soak does this for longer."""

import pytest

from tests.reliability.kills import try_kills


@pytest.mark.slow
def test_killed_trainings_of_both_stages_end_with_the_same_weights(tmp_path):
    tallies = try_kills(tmp_path, kills=5, each=3, seed=1)  # draws both kinds of moments
    assert all(tally.identical for tally in tallies)
    assert len(tallies) >= 2  # both stages
    assert sum(tally.while_writing for tally in tallies) > 0
