"""Which files are meant: in order, each once, without what is no image."""

import pytest

from dualdepth.errors import InputError
from dualdepth.inference.inputs import find_inputs, is_video


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for name in (
        "b.jpg",
        "a.PNG",
        "c.mp4",
        "ü x.tif",
        "notes.txt",
        ".hidden.png",
        "a.depth.png",
        "a.colour.png",
        "c.side.mp4",
        "sub/d.png",
    ):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    return tmp_path


def names(paths):
    return [path.name for path in paths]


def test_a_folder_stands_for_its_images_and_videos_by_name(folder):
    assert names(find_inputs([folder])) == ["a.PNG", "b.jpg", "c.mp4", "ü x.tif"]


def test_the_order_given_is_kept_and_each_file_comes_once(folder):
    assert names(find_inputs(["c.mp4", "sub", ".", "./b.jpg"])) == ["c.mp4", "d.png", "a.PNG", "b.jpg", "ü x.tif"]


def test_patterns_are_matched_and_results_of_before_are_left_out(folder):
    assert names(find_inputs(["**/*.png"])) == ["d.png"]
    assert names(find_inputs(["[ab].*"])) == ["a.PNG", "b.jpg"]


def test_a_file_is_taken_whatever_it_is_called(folder):
    (folder / "[1].png").touch()
    assert names(find_inputs(["notes.txt", "a.depth.png", "[1].png"])) == ["notes.txt", "a.depth.png", "[1].png"]


@pytest.mark.parametrize(
    ("given", "said"), [("gone.png", "no such file or folder"), ("*.xyz", "no images or videos"), ("empty", "no images")]
)
def test_what_is_not_there_is_named(folder, given, said):
    (folder / "empty").mkdir()
    with pytest.raises(InputError, match=rf"^{given.replace('*', '.')}: {said}"):
        find_inputs([given])


def test_videos_are_known_by_their_ending(folder):
    assert [is_video(path) for path in find_inputs([folder])] == [False, False, True, False]
