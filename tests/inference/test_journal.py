"""Which results are whose: names that do not clash and stay, and what is there already."""

import os

import pytest

from dualdepth.inference.journal import LONGEST, Journal, identity, plan, recipe
from dualdepth.inference.outputs import Camera, Style

STYLE = Style("about")


@pytest.fixture
def files(tmp_path):
    """Three inputs of one stem, and an unlike one."""
    paths = [tmp_path / name for name in ("a/x.png", "a/x.jpg", "b/x.png", "b/y.png")]
    for path in paths:
        path.parent.mkdir(exist_ok=True)
        path.write_text("a")
    (tmp_path / "out").mkdir()
    return paths


def done(out, paths, kinds=("colour", "depth"), weights="w" * 64, style=STYLE):
    """Does what a prediction does, with empty results."""
    journal = Journal(out)
    for task in plan(paths, out, journal, weights, style, kinds, False):
        for kind in task.kinds:
            (out / task.file(kind)).touch()
        journal.note(task.path, task.name, {kind: recipe(kind, weights, style) for kind in task.kinds}, identity(task.path))


def left(out, paths, kinds=("colour", "depth"), weights="w" * 64, style=STYLE, overwrite=False):
    return [task.kinds for task in plan(paths, out, Journal(out), weights, style, kinds, overwrite)]


def test_files_of_one_stem_get_names_of_their_own_that_stay(files, tmp_path):
    done(tmp_path / "out", files[:3])
    for order in (files[:3], files[2::-1]):
        tasks = plan(order, tmp_path / "out", Journal(tmp_path / "out"), "", STYLE, None, False)
        assert {task.path: task.name for task in tasks} == dict(zip(files, ("x", "x-2", "x-3")))


def test_what_is_there_is_left_out_and_what_is_not_is_made(files, tmp_path):
    out = tmp_path / "out"
    done(out, files[:2])
    assert left(out, files) == [(), (), ("colour", "depth"), ("colour", "depth")]
    assert left(out, files[:1], kinds=("depth", "npy")) == [("npy",)]
    (out / "x.depth.png").unlink()
    assert left(out, files[:2]) == [("depth",), ()]
    assert left(out, files[:1], overwrite=True) == [("colour", "depth")]
    done(out, files[:1])
    done(out, files[:1], ("npy", "ply"))
    kinds = ("colour", "depth", "npy", "ply")
    assert left(out, files[:1], kinds) == [()]
    assert left(out, files[:1], kinds, style=Style("about", camera=Camera(focal=5))) == [("ply",)]


def test_other_weights_a_changed_file_or_another_scale_make_it_again(files, tmp_path):
    out, all_kinds = tmp_path / "out", [("colour", "depth")]
    done(out, files[:1])
    assert left(out, files[:1], weights="v" * 64) == all_kinds
    assert left(out, files[:1], style=Style("about", 2.0)) == all_kinds
    os.utime(files[0], (1, 1))
    assert left(out, files[:1]) == all_kinds


def test_a_line_that_a_kill_has_torn_costs_only_itself_and_foreign_ones_nothing(files, tmp_path):
    out = tmp_path / "out"
    done(out, files[:2])
    journal = out / "predictions.jsonl"
    journal.write_bytes(b'[1]\n{"name": 3, "input": 1, "made": {}}\n\xff\xfe\nnull\n' + journal.read_bytes()[:-20])
    assert left(out, files[:2]) == [(), ("colour", "depth")]
    done(out, files)
    assert left(out, files) == [()] * 4


def test_names_of_any_length_and_letters_are_kept_below_what_file_systems_allow(tmp_path):
    paths = [tmp_path / ("ü" * 110 + f"{i}.png") for i in range(2)]
    for path in paths:
        path.touch()
    names = [task.name for task in plan(paths, tmp_path, Journal(tmp_path), "", STYLE, None, False)]
    assert len(set(names)) == 2
    assert all(len(name.encode()) <= LONGEST + 2 and name.startswith("üüü") for name in names)
    odd = tmp_path / os.fsdecode(b"\xff.png")
    odd.touch()
    done(tmp_path, [odd])
    assert left(tmp_path, [odd]) == [()]
