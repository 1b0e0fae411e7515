"""One run of a profile at a time; a dead run holds nothing."""

import os
import signal
import subprocess
import sys
import threading

import pytest

from dualdepth.errors import InputError
from dualdepth.files import locked, sign

HOLDER = """
import sys, time
from dualdepth.lock import locked, sign
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


def test_who_is_ending_is_waited_for(tmp_path, holder):
    threading.Timer(0.3, holder.kill).start()
    with locked(tmp_path / "lock", patience=20):
        assert str(os.getpid()) in (tmp_path / "lock").read_text()


def test_a_process_that_was_handed_the_lock_holds_it_on_when_the_one_that_took_it_is_gone(tmp_path):
    with locked(tmp_path / "lock") as file:
        heir = subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE, pass_fds=[file.fileno()])
        sign(file, f", whose heir is process {heir.pid}")
    with pytest.raises(InputError, match=f"whose heir is process {heir.pid}; wait for it or stop it"), locked(tmp_path / "lock"):
        pass
    heir.communicate(b"\n")
    with locked(tmp_path / "lock"):
        assert "heir" not in (tmp_path / "lock").read_text()
