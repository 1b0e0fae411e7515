"""What the tests of reliability share: the repository on the path, and counts of what was tried and what held."""

import sys
from contextlib import contextmanager
from pathlib import Path

import pytest

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1] / "data")]

from counting import write_count  # noqa: E402


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
