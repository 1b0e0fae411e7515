"""No bytes make a reader of images, arrays, archives or weights do anything but give a value or refuse with one line."""

import io
import json
import shutil
import zipfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from PIL import Image
from strategies import bytes_of, fuzz, read_or_refuse, values_of
from worlds import tar_of

from data_scripts.archives import unpack
from dualdepth.commands.evaluate import load_predictions
from dualdepth.data import lidar, make3d
from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.data.kitti import Frame, read_image
from dualdepth.data.label_maps import read_label_map
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import evaluate, summary
from dualdepth.files import file_digest
from dualdepth.inference import predict
from dualdepth.training.weights import load_card, load_weights, save_weights

pytestmark = [pytest.mark.fuzz, pytest.mark.slow]

DRIVE = "2011_09_26/2011_09_26_drive_0001_sync"
PICTURE = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
PROJECTION = np.array([[8.0, 0, 8, 0], [0, 8, 6, 0], [0, 0, 1, 0]]) @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])


def encoded(picture, suffix=".png", **settings) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, suffix[1:].replace("jpg", "jpeg"), **settings)
    return buffer.getvalue()


def saved(save, **arrays) -> bytes:
    """What numpy's `save` or `savez` writes."""
    buffer = io.BytesIO()
    save(buffer, **arrays)
    return buffer.getvalue()


def zipped(method: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name in ("a.txt", "b/c.bin"):
            archive.writestr(name, b"content " * 20)
    return buffer.getvalue()


def network() -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))


def weights(folder: Path) -> bytes:
    save_weights(folder / "damaged.safetensors", network(), {})
    return (folder / "damaged.safetensors").read_bytes()


def read_weights(path: Path) -> None:
    path = path.rename(path.with_suffix(".safetensors"))
    card = path.with_suffix(".json")
    card.write_text(json.dumps({"sha256": file_digest(path)}))  # whoever damages weights may also write a card
    load_weights(path, network())


def read_scan(path: Path) -> None:
    lidar.depth_from_scan(lidar.read_scan(path), PROJECTION, (12, 16))


def header(path: Path) -> None:
    image = path.parent / DRIVE / "image_02/data/0000000000.png"
    image.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(path, image)
    lidar.map_size(path.parent, Frame(DRIVE, 0))


def improved(path: Path) -> None:
    image = path.parent / "val/2011_09_26_drive_0001_sync/proj_depth/groundtruth/image_02/0000000000.png"
    image.parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(path, image)
    lidar.improved_ground_truth(path.parent, Frame(DRIVE, 0))


def extract(path: Path) -> None:
    folder = path.parent / "out"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        unpack(path, folder)
    except InputError:
        assert not [p for p in folder.rglob("*") if p.is_file()]
        raise
    assert all(p.resolve().is_relative_to(path.parent) for p in folder.rglob("*"))
    assert {p.name for p in path.parent.iterdir()} <= {"damaged", "out"}


DEPTH16 = np.full((12, 16), 2560, np.uint16)
ONES = np.ones((2, 3, 4), np.float32)
LABELS = np.tile(np.arange(16, dtype=np.uint8), (12, 1))
FILES = {
    "PNG": (encoded(PICTURE), read_image),
    "grey PNG": (encoded(PICTURE[..., 0]), read_image),
    "16-bit PNG": (encoded(DEPTH16), read_image),
    "PNG of a palette": (encoded(LABELS), read_image),
    "JPEG": (encoded(PICTURE, ".jpg"), read_image),
    "progressive JPEG": (encoded(PICTURE, ".jpg", progressive=True), read_image),
    "size of a PNG": (encoded(PICTURE), header),
    "size of a JPEG": (encoded(PICTURE, ".jpg"), header),
    "improved depth": (encoded(DEPTH16), improved),
    "label map": (encoded(LABELS), read_label_map),
    "photo": (encoded(PICTURE, ".jpg"), make3d.read_photo),
    "laser scan": (np.random.default_rng(0).uniform(-5, 5, (40, 4)).astype("<f4").tobytes(), read_scan),
    "predictions": (saved(np.save, arr=ONES), lambda p: evaluate(load_predictions(p), [np.full((3, 4), 5.0)] * 2, crop="none")),
    "ground truth in one array": (saved(np.savez, data=ONES), lambda p: list(load_ground_truth(p))),
    "zip, stored": (zipped(zipfile.ZIP_STORED), extract),
    "zip, deflated": (zipped(zipfile.ZIP_DEFLATED), extract),
    "tar.gz": (tar_of({"b/c.bin": b"content " * 20}), extract),
    "weights": (weights, read_weights),
}


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("parser", FILES)
def test_damaged_file(parser, tmp_path, counted):
    whole, read = FILES[parser]
    whole = whole if isinstance(whole, bytes) else whole(tmp_path)
    path = tmp_path / "one/damaged"

    def write_and_read(content):
        path.parent.mkdir(exist_ok=True)
        path.write_bytes(content)
        read(path)

    fuzz(counted, write_and_read, bytes_of(whole))


@pytest.mark.parametrize("kind", ["depth", "disparity"])
@pytest.mark.parametrize("resize", ["depth", "disparity"])
@pytest.mark.filterwarnings("ignore")
def test_any_floats_as_predictions(kind, resize, counted):
    shapes = st.tuples(st.just(1), st.integers(1, 3), st.integers(1, 3))
    floats = st.sampled_from([np.float16, np.float32, np.float64, np.dtype(">f4"), np.longdouble])

    truths = arrays.arrays(np.float32, st.tuples(st.integers(1, 4), st.integers(1, 4)))

    def score(prediction, truth, scaled):
        result = summary(evaluate(prediction, [truth], crop="none", kind=kind, resize=resize, median_scaling=scaled))
        assert all(np.isfinite(value) for value in result.values())

    fuzz(counted, score, arrays.arrays(floats, shapes), truths, st.booleans())


def test_cards_of_networks(tmp_path, monkeypatch, counted):
    monkeypatch.setattr("dualdepth.networks.architecture.Architecture.build", lambda self, pretrained=False: network())
    monkeypatch.setattr(predict, "PoseNet", network)
    whole = predict.Architecture(network="lr", encoder="resnet18").model_dump() | {"hr_size": [192, 192]}
    save_weights(
        tmp_path / "w.safetensors",
        SimpleNamespace(state_dict=lambda: network().state_dict(prefix="depth_net.") | network().state_dict(prefix="pose_net.")),
        whole,
    )
    digest = load_card(tmp_path / "w.safetensors")["sha256"]
    assert predict.load_depth_net(tmp_path / "w.safetensors").hr_size == (192, 192)

    def write_and_load(value):
        (tmp_path / "w.json").write_text(json.dumps(value | {"sha256": digest} if isinstance(value, dict) else value))
        for load in (predict.load_depth_net, predict.load_pose_net):
            found = read_or_refuse(load, tmp_path / "w.safetensors")
            assert not found or all(0 < side <= 10**8 for side in found.hr_size)

    fuzz(counted, write_and_load, values_of(whole))
