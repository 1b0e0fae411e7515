"""`load(weights).predict(image)`: relative depth at the image's size, the same that is scored, and what it was learned from."""

import json
import shutil

import cv2
import huggingface_hub
import numpy as np
import pytest
import torch
from small_kitti import wall
from small_nets import output_of
from torch import nn

import dualdepth
from dualdepth.inference.predict import load_depth_net, predict_disparities
from dualdepth.model import UNIT, choose_device, inference_precision
from dualdepth.training.weights import save_weights

CARD = {
    "network": "hr",
    "hr_size": [192, 288],
    "about": "a net, trained on 7 triplets: a test world",
    "drives": ["a/b"],
    "device": "AMD EPYC, 2 threads",
    "precision": "bf16",
}


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Random weights with their card, as `save_pretrained` writes them."""
    torch.manual_seed(0)
    path = tmp_path_factory.mktemp("weights")
    dualdepth.DepthModel(CARD, device="cpu").save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def model(folder):
    return dualdepth.load(folder, "cpu")


@pytest.fixture
def copy(folder, tmp_path):
    """A copy of the folder that may be damaged."""
    return shutil.copytree(folder, tmp_path / "copy")


def test_card_representation_and_hub_page_say_that_depth_is_relative_and_from_which_data(folder, model):
    card = json.loads((folder / "config.json").read_text())
    assert card.items() >= CARD.items() and model.card == card
    assert model.about.startswith("Depth is relative") and CARD["about"] in model.about
    assert model.about in repr(model) and model.about in (folder / "README.md").read_text()
    assert "began with ImageNet" in dualdepth.DepthModel(CARD | {"pretrained": True}).about
    assert "does not say what these weights were learned from" in dualdepth.DepthModel({"network": "hr", "hr_size": [192, 288]}).about


@pytest.mark.parametrize("size", [(1, 1), (16, 24), (375, 1242), (700, 301), (2160, 3840)])
def test_depth_has_the_images_size_whatever_it_is(model, size):
    depth = model.predict(cv2.resize(wall(60, 80), size[::-1]))
    assert (depth.shape, depth.dtype) == (size, np.float32)
    assert (depth >= UNIT / 10.01 * 0.999).all()
    assert (depth <= UNIT / 0.01 * 1.001).all()


def test_depth_is_what_is_scored(model, folder, tmp_path):
    """The chain predicts disparities, inverts them and resizes that bilinearly."""
    paths = [tmp_path / f"{i}.png" for i in range(2)]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), wall(120, 400, seed=i))
    disparities = predict_disparities(load_depth_net(folder / "model.safetensors"), paths)
    *together, other = model.predict_batch([*paths, wall(200, 50, seed=1)])  # images of several sizes
    for found, disparity in zip(together, disparities):
        np.testing.assert_allclose(found, UNIT * cv2.resize(1 / disparity, (400, 120)), rtol=1e-3)
    np.testing.assert_allclose(other, model.predict(wall(200, 50, seed=1)), rtol=1e-4)


@pytest.mark.parametrize(
    "image",
    [np.zeros((4, 4)), np.zeros((4, 4, 3)), np.zeros((4, 4, 4), np.uint8), np.zeros((0, 4, 3), np.uint8)],
    ids=lambda a: str(a.shape),
)
def test_arrays_that_are_no_images_are_refused(model, image):
    with pytest.raises(dualdepth.InputError, match=r"give a file, or \(H, W, 3\) uint8 RGB"):
        model.predict(image)


def test_a_trainings_own_file_and_folder_are_taken(model, tmp_path):
    whole = nn.ModuleDict({"depth_net": model.net, "pose_net": nn.Linear(1, 1)})
    save_weights(tmp_path / "model.safetensors", whole, CARD | model.architecture.model_dump())
    image = wall(60, 80)
    for weights in (tmp_path, tmp_path / "model.safetensors", str(tmp_path)):
        assert np.array_equal(dualdepth.load(weights, "cpu").predict(image), model.predict(image))


def test_a_name_on_the_hub_is_taken_from_its_cache_without_network_or_refused_in_one_line(folder, model, tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    home = tmp_path / "models--some--net"
    shutil.copytree(folder, home / "snapshots" / "abc")
    (home / "refs").mkdir()
    (home / "refs" / "main").write_text("abc")
    found = dualdepth.DepthModel.from_pretrained("some/net", cache_dir=tmp_path, local_files_only=True, device="cpu")
    assert found.card == model.card
    assert np.array_equal(found.predict(wall(60, 80)), model.predict(wall(60, 80)))
    for name in ("some/other", "no such/na me/at all"):
        with pytest.raises(dualdepth.InputError, match=f"{name}: no folder, and not to be had from the model hub") as error:
            dualdepth.load(name)
        assert "\n" not in str(error.value)
    with pytest.raises(TypeError, match="no option devise"):
        dualdepth.DepthModel.from_pretrained(folder, devise="cpu")


def change_end(file):
    file.write_bytes(file.read_bytes()[:-1] + b"\1")


@pytest.mark.parametrize(
    ("damage", "said"),
    [
        (lambda folder: change_end(folder / "model.safetensors"), "sha256 .* is not the card's"),
        (lambda folder: (folder / "model.safetensors").unlink(), "model.safetensors: cannot be read"),
        (lambda folder: (folder / "config.json").unlink(), "the weights' card cannot be read"),
        (lambda folder: (folder / "config.json").write_text("{"), "config.json: the weights' card cannot be read"),
    ],
)
def test_damaged_folders_are_refused_in_one_line(copy, damage, said):
    damage(copy)
    with pytest.raises(dualdepth.InputError, match=said):
        dualdepth.load(copy)


@pytest.mark.parametrize("changes", [{"network": "triple"}, {"hr_size": [100, 288]}, {"hr_size": [-192, 288]}, {"hr_size": 5}])
def test_a_card_that_names_no_network_is_refused(changes):
    with pytest.raises(dualdepth.InputError, match="the card names no network of this project"):
        dualdepth.DepthModel(CARD | changes)


def test_weights_that_are_not_finite_are_noticed():
    model = dualdepth.DepthModel(CARD, device="cpu")
    nn.init.constant_(next(model.net.parameters()), float("nan"))
    with pytest.raises(dualdepth.InputError, match="not finite in float32"):
        model.predict(wall(60, 80))


def test_device_and_precision_are_chosen_and_settable(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert choose_device(None) == torch.device("cpu")
    for wrong in ("cuda", "cuda:0", "mps", "tpu", "xyz:9"):
        with pytest.raises(dualdepth.InputError, match=f"device '{wrong}' is not to be had; here there are cpu"):
            choose_device(wrong)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [str(choose_device(d)) for d in (None, "cpu", "cuda:1")] == ["cuda", "cpu", "cuda:1"]
    with pytest.raises(dualdepth.InputError, match="cuda:2"):
        choose_device("cuda:2")
    for has in (True, False):
        monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation, has=has: has)
        assert inference_precision(None, torch.device("cuda")) == ("bf16" if has else "float32")
    assert inference_precision(None, torch.device("cpu")) == "float32"
    with pytest.raises(dualdepth.InputError, match="precision 'fp8' is unknown"):
        inference_precision("fp8", torch.device("cpu"))


@pytest.mark.parametrize(("precision", "dtype"), [("float32", torch.float32), ("bf16", torch.bfloat16)])
def test_the_network_computes_in_the_precision_and_depth_is_float32(precision, dtype):
    class Seen(nn.Module):
        def forward(self, image, scales):
            found = nn.functional.conv2d(image, torch.ones(1, 3, 1, 1))
            self.dtype = found.dtype
            return output_of([found.abs() + 1], found)

    seen = Seen()
    depth = dualdepth.DepthModel(CARD, seen, device="cpu", precision=precision).predict(wall(60, 80))
    assert (seen.dtype, depth.dtype) == (dtype, np.float32)
