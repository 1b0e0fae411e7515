"""README's moving picture has a page for each frame of a test street, also for those that the tables leave out."""

from types import SimpleNamespace

import numpy as np
from PIL import Image

from dualdepth.profile import load_profile
from tools import drive


def test_every_frame_of_the_first_test_street_is_drawn(tmp_path, monkeypatch):
    world = load_profile("tiny").world.model_copy(update={"test_frames": 2})
    run = SimpleNamespace(weights=lambda *_: None, profile=SimpleNamespace(seeds=[0], world=world))
    monkeypatch.setattr(drive, "Run", lambda _: run)
    monkeypatch.setattr(drive, "load", lambda _: SimpleNamespace(predict=lambda image: np.full(image.shape[:2], 2.0, np.float32)))
    drive.drive("tiny", tmp_path / "drive.webp")
    with Image.open(tmp_path / "drive.webp") as picture:
        assert picture.n_frames == 6 and picture.size[0] > 300
