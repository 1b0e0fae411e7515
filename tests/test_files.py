"""Files are whole or absent; one run holds a lock at a time, and a dead one holds nothing."""

import hashlib
import math
import os
import signal
import subprocess
import sys

import numpy as np
import pytest

from dualdepth.errors import InputError
from dualdepth.files import atomic_path, file_digest, folder_digest, locked, remove_leftovers, write_json

HOLDER = """
import os, sys, time
from dualdepth.files import locked
with locked(sys.argv[1]):
    print("held", flush=True)
    if "exec" in sys.argv:
        os.execv("/bin/sleep", ["sleep", "60"])
    time.sleep(60)
"""


@pytest.fixture
def held(tmp_path):
    """Starts another process that holds the lock; with `exec` it then becomes another program."""
    started = []

    def start(*words):
        command = [sys.executable, "-c", HOLDER, str(tmp_path / "lock"), *words]
        started.append(subprocess.Popen(command, stdout=subprocess.PIPE, text=True))
        assert started[-1].stdout.readline() == "held\n"
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.communicate()


def test_a_file_appears_under_its_name_only_when_it_is_whole(tmp_path):
    with atomic_path(tmp_path / "deep" / "seed0.npy") as partial:
        np.save(partial, np.arange(3))  # which chooses by the suffix
        assert not list((tmp_path / "deep").glob("seed*"))
        assert partial.name.startswith(".")
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["seed0.npy"]
    assert np.load(tmp_path / "deep" / "seed0.npy").tolist() == [0, 1, 2]


def test_what_a_link_names_is_replaced_and_a_pipe_is_written_itself(tmp_path):
    (tmp_path / "real.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("real.txt")
    with atomic_path(tmp_path / "link.txt") as partial:
        partial.write_text("new")
    assert (tmp_path / "link.txt").is_symlink() and (tmp_path / "real.txt").read_text() == "new"
    os.mkfifo(tmp_path / "pipe")
    with atomic_path(tmp_path / "pipe") as place:
        assert place == tmp_path / "pipe"
    assert place.is_fifo() and len(list(tmp_path.iterdir())) == 3


def test_a_failure_leaves_the_file_before_it_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as partial:
        partial.write_text("new, ha")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_what_killed_writers_left_is_removed_and_nothing_else(tmp_path):
    left = [tmp_path / ".a.0123abcd.part.txt", tmp_path / "deep" / ".checkpoint_00000004.89abcdef.part.pt"]
    kept = [tmp_path / "a.txt", tmp_path / ".hidden.part.txt"]
    (tmp_path / "deep").mkdir()
    for path in left + kept:
        path.touch()
    remove_leftovers(tmp_path, below=False)
    assert [path.exists() for path in left] == [False, True]
    remove_leftovers(tmp_path)
    assert not any(path.exists() for path in left) and all(path.exists() for path in kept)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_json_that_no_other_program_could_read_is_refused(tmp_path, value):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"x": value})
    assert not list(tmp_path.iterdir())


def test_digests_are_of_content_and_of_what_a_folder_holds(tmp_path):
    (tmp_path / "a.txt").write_bytes(b"abc")
    assert file_digest(tmp_path / "a.txt") == hashlib.sha256(b"abc").hexdigest()
    assert file_digest(tmp_path / "gone") is None
    before = folder_digest(tmp_path, "*.txt")
    (tmp_path / "b.png").touch()
    assert folder_digest(tmp_path, "*.txt") == before
    (tmp_path / "b.txt").touch()
    assert folder_digest(tmp_path, "*.txt") != before
    with_two = folder_digest(tmp_path, "*.txt")
    (tmp_path / "b.txt").write_bytes(b"1")
    assert folder_digest(tmp_path, "*.txt") != with_two
    assert folder_digest("", "*.txt") == folder_digest("", "*.png") != before


def test_a_second_run_is_refused_in_one_line_that_names_the_holder_as_often_as_it_tries(tmp_path, held):
    holder = held()
    for _ in range(2):
        said = rf"lock: held by process {holder.pid} on {os.uname().nodename}; "
        with pytest.raises(InputError, match=said) as error, locked(tmp_path / "lock"):
            pass
        assert "\n" not in str(error.value)
    with locked(tmp_path / "other" / "lock"):  # other profiles run side by side
        pass


def test_the_lock_is_free_again_when_its_holder_was_killed(tmp_path, held):
    holder = held()
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    assert str(holder.pid) in (tmp_path / "lock").read_text()
    for _ in range(2):  # and after a run that failed
        with pytest.raises(ZeroDivisionError), locked(tmp_path / "lock"):
            assert f"process {os.getpid()} on " in (tmp_path / "lock").read_text()
            _ = 1 / 0


def test_the_program_that_a_process_becomes_does_not_hold_its_lock(tmp_path, held):
    """Unless it is to, as Snakemake is: tests/reliability/test_chains.py."""
    held("exec")
    with locked(tmp_path / "lock", patience=20):
        pass
