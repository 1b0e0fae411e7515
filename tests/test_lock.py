"""One run of a profile at a time; a dead run holds nothing."""

import os
import signal
import subprocess
import sys

import pytest

from dualdepth.errors import InputError
from dualdepth.lock import locked

HOLDER = """
import sys, time
from dualdepth.lock import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    time.sleep(60)
"""


@pytest.fixture
def holder(tmp_path):
    """Another process that holds the lock."""
    process = subprocess.Popen([sys.executable, "-c", HOLDER, tmp_path / "lock"], stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_run_is_told_which_process_holds_the_lock(tmp_path, holder):
    with pytest.raises(InputError, match=f"lock: held by process {holder.pid} on "), locked(tmp_path / "lock"):
        pass


def test_being_refused_leaves_the_holders_name(tmp_path, holder):
    for _ in range(2):
        with pytest.raises(InputError, match=f"process {holder.pid} on "), locked(tmp_path / "lock"):
            pass


def test_the_lock_of_a_killed_run_is_none(tmp_path, holder):
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert (tmp_path / "lock").exists()
    with locked(tmp_path / "lock"):
        assert str(os.getpid()) in (tmp_path / "lock").read_text()


def test_the_lock_is_free_again_after_a_run_and_after_a_failed_one(tmp_path):
    with locked(tmp_path / "work" / "lock"):
        pass
    with pytest.raises(ZeroDivisionError), locked(tmp_path / "work" / "lock"):
        _ = 1 / 0
    with locked(tmp_path / "work" / "lock"):
        pass


def test_other_profiles_run_side_by_side(tmp_path, holder):
    with locked(tmp_path / "other" / "lock"):
        pass
