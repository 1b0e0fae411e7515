"""Which files are meant: in order, each once, without what is no image."""

import pytest

from dualdepth.errors import InputError
from dualdepth.inference.inputs import find_inputs


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    found, others = ["b.jpg", "a.PNG", "c.mp4", "ü x.tif", "sub/d.png"], ["notes.txt", ".hidden.png"]
    for name in [*found, *others, "a.depth.png", "a.colour.png", "c.side.mp4"]:
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).touch()
    (tmp_path / "folder.png").mkdir()
    return tmp_path


def names(paths):
    return [path.name for path in paths]


def test_a_folder_stands_for_its_images_and_videos_by_name_and_each_file_comes_once_in_the_order_given(folder):
    assert names(find_inputs([folder])) == ["a.PNG", "b.jpg", "c.mp4", "ü x.tif"]
    assert names(find_inputs(["c.mp4", "sub", ".", "./b.jpg"])) == ["c.mp4", "d.png", "a.PNG", "b.jpg", "ü x.tif"]


def test_patterns_are_matched_and_results_of_before_are_left_out(folder):
    assert names(find_inputs(["**/*.png"])) == ["d.png"]
    assert names(find_inputs(["[ab].*"])) == ["a.PNG", "b.jpg"]
    (folder / "[1].png").touch()  # a file is taken whatever it is called
    assert names(find_inputs(["notes.txt", "a.depth.png", "[1].png"])) == ["notes.txt", "a.depth.png", "[1].png"]


@pytest.mark.parametrize(
    ("given", "said"), [("gone.png", "no such file or folder"), ("*.xyz", "no images or videos"), ("empty", "no images")]
)
def test_what_is_not_there_is_named(folder, given, said):
    (folder / "empty").mkdir()
    with pytest.raises(InputError, match=rf"^{given.replace('*', '.')}: {said}"):
        find_inputs([given])
