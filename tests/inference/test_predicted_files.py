"""Which files are meant, in order and each once; names of results that do not clash and stay; and what is left to do."""

import os
import re
import time
from functools import partial

import pytest

from dualdepth.errors import InputError
from dualdepth.inference.files import LONGEST, STAMP, find_inputs, plan


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, others = ["b.jpg", "a.PNG", "c.mp4", "ü x.tif", "sub/d.png"], ["notes.txt", ".hidden.png", STAMP]
    for name in [*found, *others, "a.depth.png", "a.colour.png", "c.side.mp4"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    return tmp_path


def names(given):
    return [path.name for path in find_inputs(given)]


def test_folders_and_patterns_stand_for_their_images_and_videos_and_each_file_comes_once_in_the_order_given(folder, capsys):
    assert names([folder]) == ["a.PNG", "b.jpg", "c.mp4", "ü x.tif"] and f"'{folder}/**/*'" in capsys.readouterr().err
    for name in ("10", "9", "9.5"):
        (folder / f"sub/f{name}.png").touch()
    assert names(["sub/f*"]) == ["f9.png", "f9.5.png", "f10.png"] == names(["sub"])[1:]
    assert names(["c.mp4", "sub/d*", ".", "./b.jpg"]) == ["c.mp4", "d.png", "a.PNG", "b.jpg", "ü x.tif"]
    assert names(["**/d.*png"]) == ["d.png"] == names(["**/[ad].*png"])  # results of before are left out
    assert names(["[ab].*"]) == ["a.PNG", "b.jpg"]
    (folder / STAMP).unlink()
    assert names(["[ac].*.*"]) == ["a.colour.png", "a.depth.png", "c.side.mp4"]  # of somebody else
    (folder / "[1].png").touch()  # a file is taken whatever it is called
    assert names(["notes.txt", "a.depth.png", "[1].png"]) == ["notes.txt", "a.depth.png", "[1].png"]


@pytest.mark.parametrize(("given", "what"), [("gone.png", "such"), ("*.xyz", "file matches"), ("deep/in", "images"), ("deep", ".*'deep/")])
def test_what_is_not_there_is_named(folder, given, what):
    (folder / "deep/in").mkdir(parents=True)
    with pytest.raises(InputError, match=rf"^{re.escape(given)}: no {what}") as error:
        find_inputs([given, "gone too"])
    assert list(map(str, find_inputs([given, "b.jpg", folder / "b.jpg"]))) == [str(error.value), f"{folder}/b.jpg"]  # among others


OPTIONS = {"weights": "w", "scale": "1.0"}


@pytest.fixture
def files(tmp_path):
    """Three inputs of one stem, and a video."""
    paths = [tmp_path / name for name in ("a/x.png", "a/x.jpg", "b/x.png", "b/y.avi")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.touch()
    (tmp_path / "out").mkdir()
    return paths


@pytest.fixture
def left(tmp_path):
    """Kinds of results that are left to do of each input."""

    def call(paths, kinds=("colour", "depth"), overwrite=False, make=False, **options):
        tasks = plan(paths, tmp_path / "out", OPTIONS | options, kinds, overwrite)
        time.sleep(0.02)  # the system's clock of files is a little behind
        for path in [tmp_path / "out" / task.file(kind) for task in tasks for kind in task.kinds if make]:
            path.parent.mkdir(exist_ok=True)
            path.touch()
        return [task.kinds for task in tasks]

    return call


@pytest.fixture
def done(left):
    """Does what a prediction does, with empty results."""
    return partial(left, make=True)


def test_files_of_one_stem_get_names_of_their_own_that_stay(files, tmp_path):
    for paths in (files[:1], files, files[2::-1], [tmp_path / "b/../a/x.png"]):
        tasks = plan(paths, tmp_path / "out", OPTIONS, None, False)
        assert {task.path.resolve(): task.name for task in tasks}.items() <= dict(zip(files, ("x", "x-2", "x-3", "y"))).items()


def test_what_is_there_is_left_out_and_what_is_not_or_whose_input_changed_is_made(files, tmp_path, left, done):
    done(files[:2])
    assert left(files) == [(), (), ("colour", "depth"), ("colour", "depth")] and left(files[:1], ("depth", "npy")) == [("npy",)]
    (tmp_path / "out" / "x.depth.png").unlink()
    assert left(files[:2]) == [("depth",), ()] and left(files[1:2], overwrite=True) == [("colour", "depth")]
    done(files[3:], ("side", "npy"))
    assert left(files[3:], ("side", "npy", "ply")) == [("ply",)]
    for when in (None, (1e9, 1e9), (4e9, 4e9)):  # replaced by another, by an older one, by one of a clock that is ahead
        os.utime(files[1], when)
        assert left(files[1:2]) == [("colour", "depth")] == done(files[1:2]) and left(files[1:2]) == [()]


def test_inputs_that_were_moved_keep_their_results_and_others_of_their_name_get_new_ones(files, tmp_path, left, done):
    files[0].write_bytes(b"x")
    done(files)
    moved = [(path.parent.with_name("moved") / path.name) for path in files[:2]]
    (tmp_path / "a").rename(tmp_path / "moved")
    assert left(moved) == [(), ()] == left([*moved, *files[2:3]])[:2]
    files[0].parent.mkdir()
    files[0].write_bytes(b"another")
    assert left([*moved, files[0]]) == [(), (), ("colour", "depth")]


def test_other_options_make_all_again_also_what_a_later_run_asks_for(files, left, done, capsys):
    done(files[:2])
    assert left(files[:2]) == [(), ()] and not capsys.readouterr().out
    done(files[:1], scale="2.0")
    assert "other scale;" in capsys.readouterr().out
    assert left(files[:2], scale="2.0") == [(), ("colour", "depth")] and not capsys.readouterr().out
    assert left(files[:2]) == [("colour", "depth")] * 2


@pytest.mark.parametrize("content", [b"[1]", b"\xff", b'{"options": {}, "since": null}'])
def test_without_a_stamp_that_can_be_read_nothing_counts_as_done(files, tmp_path, left, done, content):
    done(files[:1])
    (tmp_path / "out" / STAMP).write_bytes(content)
    assert left(files[:1]) == [("colour", "depth")]


def test_names_of_any_length_and_letters_are_kept_below_what_file_systems_allow(tmp_path, left, done):
    paths = [*(tmp_path / ("ü" * 110 + f"{i}.png") for i in range(2)), tmp_path / os.fsdecode(b"\xff.png")]
    for path in paths:
        path.touch()
    found = [task.name for task in plan(paths, tmp_path, OPTIONS, None, False)]
    assert len(set(found)) == 3
    assert all(len(name.encode()) <= LONGEST + 2 for name in found) and all(name.startswith("üüü") for name in found[:2])
    done(paths)
    assert left(paths) == [()] * 3
