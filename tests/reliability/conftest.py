"""What the tests of reliability share: counts of what was tried and what held."""

from contextlib import contextmanager

import pytest
from counting import write_count
from small_training import profile_of, quiet_torch, run, triplets, whole, whole_and_log  # noqa: F401


@pytest.fixture
def counted(request):
    """A context that counts one case as tried and, when it ends well, as held; the sums go to the file that DUALDEPTH_RELIABILITY names."""
    counts = {"tried": 0, "held": 0}

    @contextmanager
    def one():
        counts["tried"] += 1
        yield
        counts["held"] += 1

    yield one
    write_count(request.node.nodeid, **counts)
