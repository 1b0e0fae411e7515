"""A disk that is full and files that vanish while a training runs: it says so, and loses nothing that was whole."""

import contextlib
import json
import os
import resource
import shutil

import pytest
from small_training import at_forward, equal, kill_softly, profile_of, quiet_torch, triplets, whole  # noqa: F401
from small_training import run as run_with  # noqa: F401

from dualdepth.errors import InputError
from dualdepth.files import write_json
from dualdepth.training.checkpoints import last_checkpoint, load_checkpoint

# ruff: noqa: F811

SMALL = 300_000
"""Bytes: more than a log or a picture, less than weights."""


def checkpoint_path(folder, step):
    return folder / f"checkpoint_{step:08d}.pt"


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
def run(run_with, profile_of):
    """Trains four steps, with a checkpoint after each second one."""
    return lambda *arguments, **settings: run_with(*arguments, profile=profile_of(stage={"max_steps": 4}), **settings)


def test_on_a_full_disk_a_training_goes_on_with_its_last_checkpoint_and_ends_in_one_line(run, whole, tmp_path, capsys, counted):
    folder = tmp_path / "run"
    with pytest.raises(SystemExit):
        run(kind=at_forward(2, kill_softly))
    before = checkpoint_path(folder, 2).read_bytes()
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
    with counted():
        assert checkpoint_path(folder, 2).read_bytes() == before and not list(folder.rglob("*.part*"))
    with counted():
        assert equal(run(), whole)  # once there is room


def test_a_table_or_card_that_does_not_fit_leaves_the_one_before(tmp_path, counted):
    path = tmp_path / "a.json"
    write_json(path, {"a": 1})
    with counted():
        with files_of_at_most(1000), pytest.raises(OSError, match="File too large"):
            write_json(path, {"a": "b" * 5000})
        assert json.loads(path.read_text()) == {"a": 1} and os.listdir(tmp_path) == ["a.json"]


@pytest.mark.filterwarnings("ignore::pytest.PytestUnhandledThreadExceptionWarning")  # TensorBoard's thread, which has lost its file
def test_a_folder_that_vanishes_is_made_again(run, whole, tmp_path, counted):
    with counted():
        assert equal(run(kind=at_forward(3, lambda _: shutil.rmtree(tmp_path / "run"))), whole)
        assert (tmp_path / "run/model.json").exists()


def test_a_folder_that_cannot_be_written_any_more_is_told_and_what_it_held_stays(run, whole, tmp_path, capsys, counted):
    """A file in its place stands for a disk that went read-only: root may write everywhere."""
    folder, aside = tmp_path / "run", tmp_path / "aside"

    def block(_):
        folder.rename(aside)
        folder.touch()

    with counted(), pytest.raises(InputError, match=r"run/model\.safetensors: could not be written"):
        run(kind=at_forward(3, block))
    with counted():
        assert "checkpoint of step 4 was not written" in capsys.readouterr().out
        assert load_checkpoint(checkpoint_path(aside, 2))["step"] == 2
    folder.unlink()
    aside.rename(folder)
    with counted():
        assert equal(run(), whole)


def test_checkpoints_that_vanish_cost_their_steps_alone(run, whole, tmp_path, counted):
    folder = tmp_path / "run"
    with pytest.raises(SystemExit):
        run(kind=at_forward(4, kill_softly))
    checkpoint_path(folder, 4).unlink()
    with counted():
        assert last_checkpoint(folder)["step"] == 2
        assert equal(run(), whole)


def test_a_frame_that_vanishes_is_named(run, kitti_root, counted):
    frame = sorted(kitti_root.rglob("*.png"))[2]
    with counted(), pytest.raises(InputError, match=rf"{frame.name}: .*") as error:
        run(kind=at_forward(1, lambda _: frame.unlink()))
    assert "\n" not in str(error.value)
