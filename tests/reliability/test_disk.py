"""A disk that is full and files that vanish while a training runs: it says so, and loses nothing that was whole."""

import contextlib
import resource
import shutil

import pytest
from small_nets import equal
from small_training import at_forward, kill_softly

from dualdepth.errors import InputError

pytestmark = pytest.mark.slow

SMALL = 300_000
"""Bytes: more than a log or a picture, less than weights."""


@contextlib.contextmanager
def files_of_at_most(size):
    """No file of this process may grow beyond `size`, as on a disk that is full."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, limits[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)


@pytest.fixture
def run(run, profile_of):
    """Trains four steps, with a checkpoint after each second one."""
    return lambda *arguments, **settings: run(*arguments, profile=profile_of(stage={"max_steps": 4}), **settings)


def test_on_a_full_disk_a_training_goes_on_with_its_last_checkpoint_and_ends_in_one_line(run, whole, tmp_path, capsys, counted):
    folder = tmp_path / "run"
    checkpoint = folder / "checkpoint_00000002.pt"
    with pytest.raises(SystemExit):
        run(kind=at_forward(2, kill_softly))
    before = checkpoint.read_bytes()
    capsys.readouterr()
    with (
        counted(),
        files_of_at_most(SMALL),
        pytest.raises(InputError, match=r"model\.safetensors: could not be written .*File too large") as error,
    ):
        run()
    said = capsys.readouterr().out
    with counted():
        assert "\n" not in str(error.value)
        assert "checkpoint of step 4 was not written" in said and "the last good one is checkpoint_00000002.pt, training goes on" in said
        assert checkpoint.read_bytes() == before and not list(folder.rglob("*.part*"))
    with counted():
        assert equal(run(), whole)  # once there is room


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # TensorBoard's thread, which has lost its file
def test_a_folder_that_vanishes_is_made_again(run, whole, tmp_path, counted):
    with counted():
        assert equal(run(kind=at_forward(3, lambda _: shutil.rmtree(tmp_path / "run"))), whole)
        assert (tmp_path / "run/model.json").exists()
