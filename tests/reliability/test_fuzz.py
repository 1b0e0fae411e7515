"""No content of a file makes a reader do anything but give a value or refuse with one line."""

import io
import json
import re
import shutil
import zipfile
from functools import partial
from pathlib import Path

import nbformat
import numpy as np
import papermill.parameterize
import pytest
import torch
import yaml
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays
from loopback import tar_of
from PIL import Image
from safetensors.torch import save
from strategies import bytes_of, fuzz, read_or_refuse, values_of
from worlds import DAY, DRIVE, written

from data_scripts import sources
from data_scripts.archives import unpack
from data_scripts.own.camera import camera_of_file
from dualdepth.data import kitti, lidar, make3d
from dualdepth.data.depth_maps import load_ground_truth
from dualdepth.data.label_maps import read_label_map
from dualdepth.data.odometry import frame_files, pair_frames, read_trajectory, sequence_intrinsics
from dualdepth.data.triplets import drive_triplets
from dualdepth.errors import InputError
from dualdepth.evaluation.depth import evaluate, load_predictions, summary
from dualdepth.evaluation.leaks import check_leak
from dualdepth.evaluation.odometry import trajectory_errors
from dualdepth.files import file_digest
from dualdepth.model import load, load_pose_net
from dualdepth.networks.architecture import Architecture
from dualdepth.notebooks import parse_parameters
from dualdepth.profile import PROFILES, load_profile
from dualdepth.run import parse_seeds
from dualdepth.training.weights import load_card, load_weights, save_weights

pytestmark = [pytest.mark.fuzz, pytest.mark.slow, pytest.mark.filterwarnings("ignore")]

FRAME = kitti.Frame(DRIVE, 0)
PROJECTION = np.array([[8.0, 0, 8, 0], [0, 8, 6, 0], [0, 0, 1, 0]]) @ np.array([[0.0, -1, 0, 0], [0, 0, -1, 0], [1, 0, 0, 0], [0, 0, 0, 1]])
NUMBERS = "2.2e+02 0 104 0 0 220 104 0 0 0 1 0"
CAMERAS = f"calib_time: 09-Jan-2012 13:57:47\nS_rect_02: 8 6\nR_rect_00: 1 0 0 0 1 0 0 0 1\nP_rect_02: {NUMBERS}\n".encode()
LASER = b"R: 0 -1 0 0 0 -1 1 0 0\nT: 0 0 -0.27\n"
LIST = f"{DRIVE} 0000000007 l\n{DRIVE} 0000000003 r\n{DRIVE} 12\n".encode()
POSES = "".join(f"1 0 0 {k} 0 1 0 0 0 0 1 {k}e-1\n" for k in range(6)).encode()
NUMBERED = "".join(f"{k} 1 0 0 {k} 0 1 0 0 0 0 1 0\n" for k in (0, 1, 2, 5, 6)).encode()
OWN = b'{"camera": {"fx": 220, "fy": 220, "cx": 104, "cy": 104, "width": 256, "height": 216, "distortion": []}, "made_from": "0"}'
OWN_KITTI = CAMERAS.replace(b"S_rect_02: 8 6", b"S_rect_02: 256 216")
camera_of_film = partial(camera_of_file, size=(216, 256))


def laser_calibration(path: Path) -> None:
    lidar.velodyne_projection(path.parents[1], DAY)
    np.zeros(lidar.map_size(path.parents[1], FRAME))


def trajectory(path: Path) -> None:
    whole = path.with_name("whole.txt")
    whole.write_bytes(POSES)
    prediction, truth = read_trajectory(path), read_trajectory(whole)
    pair_frames(prediction, truth)
    trajectory_errors(truth, prediction, "7dof")


TEXTS = {
    "frame list": ("list.txt", LIST, kitti.read_frame_list),
    "static frames": ("static.txt", b"2011_09_26 2011_09_26_drive_0001_sync 0000000005\n" * 2, kitti.read_static_frames),
    "test scenes": ("scenes.txt", b"2011_09_26_drive_0001\n2011_09_28_drive_0002\n", kitti.read_test_scenes),
    "calib_cam_to_cam": (f"{DAY}/calib_cam_to_cam.txt", CAMERAS, laser_calibration),
    "calib_velo_to_cam": (f"{DAY}/calib_velo_to_cam.txt", LASER, laser_calibration),
    **{
        f"odometry {name}": (f"sequences/00/{name}", whole.encode(), lambda path: sequence_intrinsics(path.parents[2], "00:image_0"))
        for name, whole in {"calib.txt": f"P0: {NUMBERS}\nP1: {NUMBERS}\n", "calib_p0_p1.txt": f"{NUMBERS}\n{NUMBERS}\n"}.items()
    },
    "poses": ("poses.txt", POSES, trajectory),
    "numbered poses": ("poses.txt", NUMBERED, trajectory),
    "profile as text": ("own.yaml", (PROFILES / "tiny.yaml").read_bytes(), lambda path: load_profile(str(path))),
    "own camera's intrinsics": ("own.json", OWN, camera_of_film),
    "own camera's KITTI calibration": ("calib.txt", OWN_KITTI, camera_of_film),
    "card as text": ("w.json", b'{"network": "lr", "drives": ["a"], "sha256": "0"}', load_card),
}


def picture(pixels: np.ndarray, kind: str = "png", **settings: object) -> bytes:
    return written(Image.fromarray(pixels).save, kind, **settings)


def zipped(method: int) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as archive:
        for name in ("a.txt", "b/c.bin"):
            archive.writestr(name, b"content " * 20)
    return buffer.getvalue()


def network() -> torch.nn.Module:
    return torch.nn.Sequential(torch.nn.Linear(2, 2), torch.nn.BatchNorm1d(2))


def read_weights(path: Path) -> None:
    path.with_suffix(".json").write_text(json.dumps({"sha256": file_digest(path)}))  # whoever damages weights may also write a card
    load_weights(path, network())


def extract(path: Path) -> None:
    folder = path.parent / "out"
    shutil.rmtree(folder, ignore_errors=True)
    try:
        unpack(path, folder)
    except InputError:
        assert not [p for p in folder.rglob("*") if p.is_file()]
        raise
    assert all(p.resolve().is_relative_to(path.parent) for p in folder.rglob("*"))
    assert {p.name for p in path.parent.iterdir()} <= {path.name, "out"}


RGB = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8)
DEPTH16 = np.full((12, 16), 2560, np.uint16)
ONES = np.ones((2, 3, 4), np.float32)
LABELS = np.tile(np.arange(16, dtype=np.uint8), (12, 1))
SCAN = np.random.default_rng(0).uniform(-5, 5, (40, 4)).astype("<f4").tobytes()
IMAGE = f"{DRIVE}/image_02/data/0000000000.png"
IMPROVED = "val/2011_09_26_drive_0001_sync/proj_depth/groundtruth/image_02/0000000000.png"
FILES = {
    "PNG": ("damaged", picture(RGB), kitti.read_image),
    "grey PNG": ("damaged", picture(RGB[..., 0]), kitti.read_image),
    "16-bit PNG": ("damaged", picture(DEPTH16), kitti.read_image),
    "PNG of a palette": ("damaged", picture(LABELS), kitti.read_image),
    "JPEG": ("damaged", picture(RGB, "jpeg"), kitti.read_image),
    "progressive JPEG": ("damaged", picture(RGB, "jpeg", progressive=True), kitti.read_image),
    "size of a PNG": (IMAGE, picture(RGB), lambda path: lidar.map_size(path.parents[4], FRAME)),
    "size of a JPEG": (IMAGE, picture(RGB, "jpeg"), lambda path: lidar.map_size(path.parents[4], FRAME)),
    "improved depth": (IMPROVED, picture(DEPTH16), lambda path: lidar.improved_ground_truth(path.parents[5], FRAME)),
    "label map": ("damaged", picture(LABELS), read_label_map),
    "photo": ("damaged", picture(RGB, "jpeg"), make3d.read_photo),
    "laser scan": ("damaged", SCAN, lambda path: lidar.depth_from_scan(lidar.read_scan(path), PROJECTION, (12, 16))),
    "predictions": ("damaged", written(np.save, ONES), lambda p: evaluate(load_predictions(p), [np.full((3, 4), 5.0)] * 2, crop="none")),
    "ground truth in one array": ("damaged", written(np.savez, data=ONES), lambda path: list(load_ground_truth(path))),
    "zip, stored": ("one/archive", zipped(zipfile.ZIP_STORED), extract),
    "zip, deflated": ("one/archive", zipped(zipfile.ZIP_DEFLATED), extract),
    "tar.gz": ("one/archive", tar_of({"b/c.bin": b"content " * 20}), extract),
    "weights": ("w.safetensors", save(network().state_dict()), read_weights),
}


@pytest.mark.parametrize("parser", [*TEXTS, *FILES])
def test_damaged_file(parser, tmp_path, counted):
    name, whole, read = (TEXTS | FILES)[parser]
    path = tmp_path / name
    path.parent.mkdir(parents=True, exist_ok=True)
    (tmp_path / DAY).mkdir(exist_ok=True)
    for beside, content in (("cam_to_cam", CAMERAS), ("velo_to_cam", LASER)):
        (tmp_path / DAY / f"calib_{beside}.txt").write_bytes(content)

    def write_and_read(content):
        path.write_bytes(content)
        read(path)

    write_and_read(whole)  # what is not damaged is read
    fuzz(counted, write_and_read, bytes_of(whole, words=parser in TEXTS))


@pytest.mark.parametrize("kind", ["depth", "disparity"])
@pytest.mark.parametrize("resize", ["depth", "disparity"])
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
    monkeypatch.setattr("dualdepth.model.make_pose_net", lambda encoder: network())
    whole = Architecture(network="lr", encoder="resnet18").model_dump() | {"hr_size": [192, 192], "pose_encoder": None}
    save_weights(tmp_path / "w.safetensors", torch.nn.ModuleDict({"depth_net": network(), "pose_net": network()}), whole)
    digest = load_card(tmp_path / "w.safetensors")["sha256"]
    assert load(tmp_path / "w.safetensors", "cpu").size == load_pose_net(tmp_path / "w.safetensors")[1] == (192, 192)

    def write_and_load(value):
        (tmp_path / "w.json").write_text(json.dumps(value | {"sha256": digest} if isinstance(value, dict) else value))
        for read in (load, load_pose_net):
            found = read_or_refuse(partial(read, device="cpu"), tmp_path / "w.safetensors")
            assert not found or all(0 < side <= 10**8 for side in (found[1] if isinstance(found, tuple) else found.size))

    fuzz(counted, write_and_load, values_of(whole))


def profile(folder: Path, value) -> None:
    (folder / "own.yaml").write_text(yaml.safe_dump(value, allow_unicode=True))
    load_profile(str(folder / "own.yaml"))


def card(folder: Path, value) -> None:
    (folder / "w.json").write_text(json.dumps(value))
    check_leak(load_card(folder / "w.safetensors"), ["a", DRIVE], allow=True)


VALUES = {
    "profile": (yaml.safe_load((PROFILES / "paper.yaml").read_text()), profile),
    "profile with variants": (
        {
            "about": "a test",
            "data": {"source": "kitti", "train_drives": [DRIVE]},
            "train": {"lr": {"training.lr.max_steps": 1}, "mine": None},
            "variants": {"mine": {"label": "m", "about": "m", "network": "dual", "starts_from": "lr", "set": {"training.hr.max_steps": 6}}},
        },
        profile,
    ),
    "card": ({"network": "lr", "encoder": "resnet18", "drives": ["a"], "hr_size": [192, 192], "sha256": "0"}, card),
}


@pytest.mark.parametrize("parser", VALUES)
def test_damaged_values(parser, tmp_path, counted):
    whole, read = VALUES[parser]
    read(tmp_path, whole)
    fuzz(counted, lambda value: read(tmp_path, value), values_of(whole))


ODD = st.text(max_size=12) | st.from_regex(r"-{0,3}[0-9²٣,_ ]{1,6}") | st.just("9" * 5000)
FILE_NAMES = st.lists(st.sampled_from(["0000000001", "²", "٣", "1.5", "-1", "ñ ö", "", "9" * 200, "1"]), max_size=4)


@pytest.mark.parametrize("parse", [parse_seeds, lambda text: sources.drive_archives([text]), lambda text: parse_parameters([text])])
def test_odd_words_of_the_command_line(parse, counted):
    fuzz(counted, parse, ODD | ODD.map(lambda text: f"seed={text}"))


def test_odd_names_of_files_in_a_folder_of_frames(tmp_path_factory, counted):
    def write_and_read(stems, suffix):
        root = tmp_path_factory.mktemp("root")
        for folder in (root / DRIVE / "image_02/data", root / "sequences/00/image_2"):
            folder.mkdir(parents=True)
            for stem in stems:
                (folder / f"{stem}{suffix}").touch()
        read_or_refuse(drive_triplets, root, [DRIVE])
        read_or_refuse(frame_files, root, "00")

    fuzz(counted, write_and_read, FILE_NAMES, st.sampled_from([".png", ".jpg", ".txt"]))


CODE = ['__import__("os").system("touch X")', '"; open("X", "w"); "', "'''\nopen('X', 'w')\n'''", "{open('X', 'w')}", "!touch X", "%run X"]


def test_a_parameter_of_a_notebook_is_data_and_never_code(tmp_path, monkeypatch, counted):
    monkeypatch.chdir(tmp_path)
    kernel = {"kernelspec": {"name": "python3", "display_name": "Python 3", "language": "python"}, "papermill": {}}
    cell = nbformat.v4.new_code_cell('text = ""', metadata={"tags": ["parameters"]})

    def pass_on(value):
        """The notebook has what stands after `--set text=`, by the cell that papermill puts into it, which is run here."""
        notebook, names = nbformat.v4.new_notebook(cells=[cell], metadata=kernel), {}
        filled = papermill.parameterize.parameterize_notebook(notebook, parse_parameters([f"text={value}"]))
        exec("\n".join(cell.source for cell in filled.cells), names)
        assert names["text"] == value and not list(tmp_path.iterdir())

    for value in (*CODE, "\\\"; open('X', 'w') #", "$(touch X)"):
        pass_on(value)
    text = st.text(st.characters(exclude_categories=["Cs"]), max_size=20)
    fuzz(counted, pass_on, text.filter(lambda value: not re.fullmatch("-?[0-9]+", value)))
