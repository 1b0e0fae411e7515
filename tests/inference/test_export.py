"""Exported networks: the same disparities as PyTorch's for any batch, no more than what shapes them, and nothing half-written."""

import importlib.util
import json
import math
import shutil
import tomllib

import cv2
import numpy as np
import onnx
import pytest
import torch
from small_kitti import wall
from small_nets import as_trained

from dualdepth.cli import main
from dualdepth.data.kitti import read_image
from dualdepth.errors import InputError
from dualdepth.geometry import to_unit
from dualdepth.inference import export
from dualdepth.inference.export import TOLERANCE, export_onnx, run_onnx
from dualdepth.model import DepthModel, load, tensor_of
from dualdepth.networks.architecture import Architecture
from dualdepth.run import project_root

SIZE = (192, 288)


def decoder_of(net):
    """The decoder whose disparity is exported."""
    return net.hr_net.decoder if hasattr(net, "hr_net") else net.decoder


@pytest.fixture(scope="module")
def save(encoder, tmp_path_factory):
    """Saves weights in a folder of their own; gives their path."""

    def call(network):
        torch.manual_seed(0)
        words = Architecture(network=network, encoder=encoder).model_dump()
        model = DepthModel(words | {"hr_size": list(SIZE), "about": "a test", "drives": ["street/1"]}, device="cpu")
        as_trained(model)
        folder = tmp_path_factory.mktemp("weights")
        model.save_pretrained(folder)
        return folder / "model.safetensors"

    return call


@pytest.fixture(scope="module")
def weights(save):
    """Of LR-Net, whose graph is written soonest and averages the image."""
    return save("lr")


@pytest.fixture(scope="module")
def lr_file(weights, tmp_path_factory):
    """These, exported: some seconds, so once."""
    out = tmp_path_factory.mktemp("file") / "depth.onnx"
    export_onnx(weights, out)
    return out


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Three image files of another size than the network's."""
    folder = tmp_path_factory.mktemp("frames")
    for seed in range(3):
        cv2.imwrite(str(folder / f"{seed}.png"), wall(100, 310, seed=seed))
    return sorted(folder.iterdir())


def check_graph(weights, file, paths):
    """The file gives PyTorch's disparities of images in any batch, and holds the numbers that shape them and no others."""
    model = load(weights, "cpu", "float32")
    expected = model.disparities(paths)  # from the files: resized, and averaged for LR-Net
    assert expected.max() > 1.2 * expected.min()
    images = torch.stack([to_unit(tensor_of(read_image(path), SIZE)) for path in paths]).numpy()
    together, *alone = run_onnx(file, [images, *(image[None] for image in images)])
    for found in (together, np.concatenate(alone)):
        np.testing.assert_allclose(found[:, 0], expected, rtol=TOLERANCE)
        assert np.median(np.abs(found[:, 0] / expected - 1)) < 1e-5
    net = model.depth_net
    unused = [*decoder_of(net).heads[:-1], *([net.lr_net.decoder] if hasattr(net, "lr_net") else [])]
    wanted, left = (sum(p.numel() for module in modules for p in module.parameters()) for modules in ([net], unused))
    written = sum(math.prod(tensor.dims) for tensor in onnx.load(file).graph.initializer)
    assert abs(written / (wanted - left) - 1) < 0.01  # batch norm goes into the convolutions


@pytest.mark.slow
def test_the_dual_network_gives_pytorchs_disparities_in_any_batch(save, frames, tmp_path, capfd):
    weights, out = save("dual"), tmp_path / "new folder" / "depth.onnx"
    assert main(["export", "--to", "onnx", "--weights", str(weights), "--out", str(out), "--frames", *map(str, frames)]) == 0
    said = capfd.readouterr()
    assert "(B, 3, 192, 288) -> disparity (B, 1, 192, 288)" in said.out and "PyTorch on 3 images" in said.out and said.err == ""
    check_graph(weights, out, frames)


def test_lr_net_takes_the_frame_itself_and_gives_a_third_of_its_size(weights, lr_file, frames):
    assert run_onnx(lr_file, [np.zeros((2, 3, *SIZE), np.float32)])[0].shape == (2, 1, 64, 96)
    check_graph(weights, lr_file, frames)


def test_the_file_says_what_it_is_and_nothing_of_this_machine(weights, lr_file):
    said = {entry.key: entry.value for entry in onnx.load(lr_file).metadata_props}
    assert set(said) == {"about", "image", "disparity", "scale", "hr_size", "card"}
    assert said["about"] == "a test" and "[0, 1]" in said["image"] and "relative" in said["scale"] and said["hr_size"] == "[192, 288]"
    assert json.loads(said["card"]) == json.loads(weights.with_name("config.json").read_text())
    assert str(project_root()).encode() not in lr_file.read_bytes()


def test_a_file_that_differs_from_pytorch_or_cannot_be_run_is_not_left(weights, lr_file, tmp_path, monkeypatch):
    monkeypatch.setattr(export, "write_onnx", lambda model, path: shutil.copy(lr_file, path))
    model, out = load(weights, "cpu"), tmp_path / "out" / "depth.onnx"
    decoder_of(model.depth_net).heads[-1].bias.data.add_(0.1)
    model.save_pretrained(tmp_path / "changed")
    with pytest.raises(InputError, match=r"depth\.onnx: not written.*by 0\.0"):
        export_onnx(tmp_path / "changed", out)
    monkeypatch.setattr(export, "write_onnx", lambda model, path: path.write_bytes(b"no graph"))
    with pytest.raises(InputError, match=r"depth\.onnx: not written.*run it"):
        export_onnx(weights, out)
    assert list(out.parent.iterdir()) == []


@pytest.mark.parametrize(
    ("option", "value", "said"),
    [
        ("--to", "coreml", "'coreml'"),
        ("--weights", "none.safetensors", "none.safetensors: "),
        ("--out", "model.safetensors", "model.safetensors: "),
        ("--out", "file/depth.onnx", "file: "),
        ("--frames", "none.png", "none.png"),
    ],
)
def test_mistakes_end_in_one_line(weights, tmp_path, monkeypatch, refused, option, value, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    words = {"--to": "onnx", "--weights": str(weights), "--out": "depth.onnx"} | {option: value}
    assert said in refused(main, ["export", *(word for pair in words.items() for word in pair)])
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


@pytest.mark.parametrize("missing", ["onnx", "onnxscript", "onnxruntime"])
def test_without_the_packages_it_says_how_to_get_them(weights, tmp_path, monkeypatch, missing):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == missing else find(name))
    groups = tomllib.loads((project_root() / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    install = " ".join(line.partition(">=")[0] for line in groups["export"])
    with pytest.raises(InputError, match=f"package {missing} .*`pip install {install}`"):
        export_onnx(weights, tmp_path / "depth.onnx")
