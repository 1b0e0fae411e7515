"""Label maps as they are read: the ids of the file and nothing else, and one line for all that is no label map."""

import cv2
import numpy as np
import pytest
from PIL import Image

from dualdepth.data.kitti import Frame
from dualdepth.data.label_maps import CITYSCAPES, LabelMaps, label_path, read_label_map
from dualdepth.errors import InputError

DRIVE = "2011_09_26_drive_0052_sync"


def every_id(size=(7, 11)):
    return np.resize(np.array([*range(19), 255], np.uint8), size)


def fails(path):
    with pytest.raises(InputError) as error:
        read_label_map(path)
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    return str(error.value)


def test_every_training_id_and_ignore_come_back_as_they_were_written(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), every_id())
    labels = read_label_map(tmp_path / "a.png")
    assert labels.dtype == np.uint8
    np.testing.assert_array_equal(labels, every_id())


def test_of_a_palette_the_indices_count(tmp_path):
    image = Image.fromarray(every_id())
    image.putpalette([255 - i // 3 for i in range(768)])
    image.save(tmp_path / "a.png")
    assert Image.open(tmp_path / "a.png").mode == "P"
    np.testing.assert_array_equal(read_label_map(tmp_path / "a.png"), every_id())


def test_the_names_stand_at_cityscapes_training_ids():
    names = "road sidewalk building wall fence pole traffic_light traffic_sign vegetation terrain sky person rider car truck bus train"
    assert tuple(name.replace("_", " ") for name in [*names.split(), "motorcycle", "bicycle"]) == CITYSCAPES


def test_a_frame_has_its_map_below_its_drive_and_maps_are_read_in_order(tmp_path):
    frames = [Frame(f"2011_09_26/{DRIVE}", index) for index in (12, 3)]
    assert label_path(tmp_path, frames[0]) == tmp_path / DRIVE / "0000000012.png"
    (tmp_path / DRIVE).mkdir()
    for value, frame in enumerate(frames):
        cv2.imwrite(str(label_path(tmp_path, frame)), np.full((2, 3), value, np.uint8))
    maps = LabelMaps(tmp_path, frames)
    assert len(maps) == 2 and [int(m[0, 0]) for m in maps] == [0, 1]


def test_a_missing_map_is_named_with_the_script_that_makes_it(tmp_path):
    assert "export_labels.py" in fails(tmp_path / "none.png") and "export_labels.py" in fails(tmp_path)


def test_what_is_no_png_is_named(tmp_path):
    cv2.imwrite(str(tmp_path / "a.jpg"), every_id())
    (tmp_path / "a.png").write_bytes((tmp_path / "a.jpg").read_bytes())
    assert "not a PNG file" in fails(tmp_path / "a.png")


@pytest.mark.parametrize("channels", [3, 4])
def test_colours_are_refused_even_grey_ones(tmp_path, channels):
    cv2.imwrite(str(tmp_path / "a.png"), np.repeat(every_id()[..., None], channels, axis=2))
    assert "holds colours; give training ids 0 to 18" in fails(tmp_path / "a.png")


def test_other_depths_are_refused(tmp_path):
    cv2.imwrite(str(tmp_path / "a.png"), every_id().astype(np.uint16))
    assert "16 bits" in fails(tmp_path / "a.png")
    Image.fromarray(every_id() > 9).save(tmp_path / "a.png")
    assert "1 bits" in fails(tmp_path / "a.png")


def test_raw_ids_are_refused_by_number(tmp_path):
    labels = every_id()
    labels[0, :3] = (24, 33, 19)
    cv2.imwrite(str(tmp_path / "a.png"), labels)
    message = fails(tmp_path / "a.png")
    assert "holds 19, 24, 33; training ids are 0 to 18 and 255" in message and "labelIds" in message
