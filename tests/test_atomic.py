"""Files are whole or absent."""

import json
import math

import numpy as np
import pytest

from dualdepth.files import atomic_path, write_json, write_text


def test_a_file_appears_under_its_name_only_when_it_is_whole(tmp_path):
    with atomic_path(tmp_path / "deep" / "a.txt") as partial:
        partial.write_text("half")
        assert not (tmp_path / "deep" / "a.txt").exists()
    assert [p.name for p in (tmp_path / "deep").iterdir()] == ["a.txt"]


def test_a_failure_leaves_the_file_before_it_and_nothing_else(tmp_path):
    path = tmp_path / "a.txt"
    path.write_text("old")
    with pytest.raises(KeyboardInterrupt), atomic_path(path) as partial:
        partial.write_text("new, ha")
        raise KeyboardInterrupt
    assert path.read_text() == "old"
    assert [p.name for p in tmp_path.iterdir()] == ["a.txt"]


def test_the_suffix_is_kept_for_writers_that_choose_by_it(tmp_path):
    with atomic_path(tmp_path / "a.npy") as partial:
        np.save(partial, np.arange(3))
    assert np.load(tmp_path / "a.npy").tolist() == [0, 1, 2]


def test_the_unfinished_file_does_not_pass_for_a_result(tmp_path):
    with atomic_path(tmp_path / "seed0.csv") as partial:
        partial.touch()
        assert not list(tmp_path.glob("seed*"))
        assert partial.name.startswith(".")


def test_two_writers_do_not_share_an_unfinished_file(tmp_path):
    with atomic_path(tmp_path / "a.txt") as first, atomic_path(tmp_path / "a.txt") as second:
        first.write_text("first")
        second.write_text("second")
    assert (tmp_path / "a.txt").read_text() == "first"  # the last one to end


def test_text_and_json_are_utf_8(tmp_path):
    write_text(tmp_path / "a.txt", "δ < 1.25²")
    write_json(tmp_path / "a.json", {"about": "λ", "n": 3})
    assert (tmp_path / "a.txt").read_bytes().decode("utf-8") == "δ < 1.25²"
    assert json.loads((tmp_path / "a.json").read_text(encoding="utf-8")) == {"about": "λ", "n": 3}


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_json_that_no_other_program_could_read_is_refused(tmp_path, value):
    with pytest.raises(ValueError, match="JSON"):
        write_json(tmp_path / "a.json", {"x": value})
    assert not list(tmp_path.iterdir())
