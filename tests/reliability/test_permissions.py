"""Files and folders without permission: exit code 2 and one line that names them, also where the tests run as root."""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import pytest


@pytest.fixture(scope="module")
def outcomes():
    """What came of each command in `unprivileged.py`; below no folder of pytest's, which are closed to other users."""
    with tempfile.TemporaryDirectory() as folder:
        script = Path(__file__).with_name("unprivileged.py")
        done = subprocess.run([sys.executable, str(script), folder], capture_output=True, text=True, check=False)
    if done.returncode == 77:
        pytest.skip("the rights of root cannot be given up here")
    assert done.returncode == 0, done.stderr
    return json.loads(done.stdout)


def test_what_may_not_be_touched_is_named_in_one_line(outcomes, counted):
    assert len(outcomes) >= 10
    for case, found in outcomes.items():
        named = {".": "out.", "w.json": "w.json"}.get(name := case.split()[-1], name)
        with counted():
            said = found["said"].splitlines()
            assert found["code"] == 2, (case, found)
            assert len(said) == 1 and said[0].startswith("error: ") and named in said[0], (case, found)
            assert found["left"] == []
