"""Label maps as they are read: the ids of the file and nothing else. What is no label map stands in tests/reliability/bad_inputs.py."""

import numpy as np
from PIL import Image

from dualdepth.data.label_maps import read_label_map


def test_every_training_id_and_ignore_come_back_as_they_were_written_and_of_a_palette_the_indices_count(tmp_path):
    every_id = np.resize(np.array([*range(19), 255], np.uint8), (7, 11))
    path, image = tmp_path / "a.png", Image.fromarray(every_id)
    image.save(path)
    assert read_label_map(path).dtype == np.uint8
    np.testing.assert_array_equal(read_label_map(path), every_id)
    image.putpalette([255 - i // 3 for i in range(768)])
    image.save(path)
    assert Image.open(path).mode == "P"
    np.testing.assert_array_equal(read_label_map(path), every_id)
