"""Exported networks: the same disparities as PyTorch's for any batch, no more than what shapes them, and nothing half-written."""

import importlib.util
import json
import math
import shutil
import tomllib

import numpy as np
import onnx
import pytest
import torch
from dualdepth.onnx_session import load_onnx
from torch import nn

from data_scripts.miniature.frames import write_shot
from data_scripts.miniature.plan import plan_world
from dualdepth.cli import main
from dualdepth.errors import InputError
from dualdepth.inference import export
from dualdepth.inference.export import TOLERANCE, ImageToDisparity, made_up_images
from dualdepth.inference.predict import load_depth_net, predict_disparities
from dualdepth.networks.architecture import Architecture
from dualdepth.run import project_root
from dualdepth.settings import World
from dualdepth.training.weights import save_weights

SIZE = (192, 288)
GRAPHS = {
    "lr": {"network": "lr"},
    "single": {"network": "single"},
    "hr": {"network": "hr"},
    "dual": {"network": "dual"},
    "dual, direct": {"network": "dual", "link": "direct"},
    "dual, embedding": {"network": "dual", "link": "embedding"},
}


@pytest.fixture(scope="module")
def frames(tmp_path_factory):
    """Three frames of the synthetic world."""
    folder = tmp_path_factory.mktemp("world")
    shots = [s for s in plan_world(World(size=(48, 152), supersample=2, frames_per_drive=6), folder).shots if "image_02" in str(s.image)][
        :3
    ]
    paths = []
    for number, shot in enumerate(shots):
        paths.append(folder / f"{number}{shot.image.suffix}")
        write_shot(shot._replace(image=paths[-1], depth=None, labels=None, scan=None, grid=None))
    return paths


def decoder_of(net):
    """The decoder whose disparity is exported."""
    return net.hr_net.decoder if hasattr(net, "hr_net") else net.decoder


def finest_head(net):
    """The layer before the finest disparity's sigmoid."""
    return decoder_of(net).heads[-1]


@torch.no_grad()
def spread(net, low):
    """New weights give one disparity everywhere; let these have statistics and reach from near to far, as trained ones do."""
    images = torch.from_numpy(np.stack(made_up_images(SIZE)))
    images = nn.functional.avg_pool2d(images, 3) if low else images
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = 1.0  # one batch is the whole statistics
    net.train()(images)
    seen = []
    head = finest_head(net.eval())
    with head.register_forward_hook(lambda _module, _inputs, logits: seen.append(logits)):
        net(images)
    gain = 2 / seen[0].std()
    head.bias.copy_((head.bias - seen[0].mean()) * gain)
    head.weight.mul_(gain)


@pytest.fixture(scope="module")
def save(encoder, tmp_path_factory):
    """Saves weights as a training does, in a folder of their own; gives their path."""

    def call(**words):
        torch.manual_seed(0)
        architecture = Architecture(**{"encoder": encoder} | words)
        net = architecture.build()
        spread(net, architecture.sees_low_resolution)
        whole = nn.ModuleDict({"depth_net": net, "pose_net": nn.Linear(1, 1)})
        path = tmp_path_factory.mktemp("weights") / "model.safetensors"
        save_weights(path, whole, architecture.words() | {"hr_size": list(SIZE), "about": "a test", "drives": ["street/1"]})
        return path

    return call


@pytest.fixture(scope="module")
def hr_weights(save):
    """Of the network that is exported soonest."""
    return save(network="hr")


@pytest.fixture(scope="module")
def hr_file(hr_weights, tmp_path_factory):
    """These, exported: some seconds, so once."""
    return export.export_onnx(hr_weights, tmp_path_factory.mktemp("file") / "depth.onnx").path


@pytest.fixture
def written_already(hr_file, monkeypatch):
    """An export that writes that file."""
    monkeypatch.setattr(export, "write_onnx", lambda net, size, path, words: shutil.copy(hr_file, path))


@pytest.mark.slow
@pytest.mark.parametrize("words", GRAPHS.values(), ids=GRAPHS)
def test_every_network_gives_pytorchs_disparities_in_any_batch(save, frames, tmp_path, capfd, words):
    weights, out = save(**words), tmp_path / "new folder" / "depth.onnx"
    assert main(["export", "--to", "onnx", "--weights", str(weights), "--out", str(out), "--frames", *map(str, frames)]) == 0
    said = capfd.readouterr()
    shrink = 3 if words["network"] == "lr" else 1
    size = (SIZE[0] // shrink, SIZE[1] // shrink)
    assert f"image (B, 3, 192, 288) -> disparity (B, 1, {size[0]}, {size[1]})" in said.out
    assert "largest relative difference from PyTorch on 3 images" in said.out and said.err == ""

    depth_net = load_depth_net(weights)
    expected = predict_disparities(depth_net, frames)  # from the files: resized, and averaged for LR-Net
    assert expected.max() > 1.5 * expected.min()
    images = np.stack([export._read(path, SIZE) for path in frames])
    loaded = load_onnx(out)
    assert loaded.output_size == size
    for found in (loaded(images), np.concatenate([loaded(image[None]) for image in images])):
        np.testing.assert_allclose(found[:, 0], expected, rtol=TOLERANCE)
        assert np.median(np.abs(found[:, 0] / expected - 1)) < 1e-5

    written = sum(math.prod(tensor.dims) for tensor in onnx.load(out).graph.initializer)
    net = depth_net.net
    unused = [*decoder_of(net).heads[:-1], *([net.lr_net.decoder] if words["network"] == "dual" else [])]
    needed = count(net) - sum(map(count, unused))
    assert abs(written / needed - 1) < 0.01  # batch norm goes into the convolutions


def count(module):
    """Numbers in its parameters."""
    return sum(parameter.numel() for parameter in module.parameters())


def test_the_file_says_what_it_is_and_nothing_of_this_machine(hr_weights, hr_file):
    said = {entry.key: entry.value for entry in onnx.load(hr_file).metadata_props}
    assert set(said) == {"about", "image", "disparity", "scale", "hr_size", "card"}
    assert said["about"] == "a test" and "[0, 1]" in said["image"] and "relative" in said["scale"] and said["hr_size"] == "[192, 288]"
    assert json.loads(said["card"]) == json.loads(hr_weights.with_suffix(".json").read_text()) == load_onnx(hr_file).card
    assert load_onnx(hr_file).card["drives"] == ["street/1"]
    assert str(project_root()).encode() not in hr_file.read_bytes()


@pytest.mark.usefixtures("written_already")
def test_a_file_that_differs_from_pytorch_is_not_left(hr_weights, tmp_path, capfd):
    net = load_depth_net(hr_weights).net
    finest_head(net).bias.data.add_(0.1)
    folder = tmp_path / "out"
    save_weights(tmp_path / "w.safetensors", nn.ModuleDict({"depth_net": net}), json.loads(hr_weights.with_suffix(".json").read_text()))
    with pytest.raises(SystemExit) as stop:
        main(["export", "--to", "onnx", "--weights", str(tmp_path / "w.safetensors"), "--out", str(folder / "depth.onnx")])
    err = capfd.readouterr().err
    assert stop.value.code == 2 and len(err.splitlines()) == 1
    assert "depth.onnx: not written, since ONNX Runtime's disparities are off PyTorch's by 0.0" in err
    assert list(folder.iterdir()) == []


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--to", "coreml"], "invalid choice: 'coreml'"),
        (["--to", "onnx", "--weights", "none.safetensors"], "none.json: the weights' card cannot be read"),
        (
            ["--to", "onnx", "--out", "model.safetensors"],
            "model.safetensors: is no name for an ONNX file; give --out one that ends in .onnx",
        ),
        (["--to", "onnx", "--out", "file/depth.onnx"], "file: nothing can be written there"),
        (["--to", "onnx", "--frames", "none.png"], "none.png"),
    ],
    ids=str,
)
def test_mistakes_end_in_one_line(hr_weights, tmp_path, monkeypatch, capfd, arguments, said):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "file").touch()
    given = dict(zip(arguments[::2], arguments[1::2]))
    words = {"--weights": str(hr_weights), "--out": "depth.onnx"} | given
    with pytest.raises(SystemExit) as stop:
        main(["export", *(word for pair in words.items() for word in pair)])
    err = capfd.readouterr().err
    assert stop.value.code == 2 and len(err.splitlines()) == 1 and err.startswith("error: ") and said in err
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_damaged_weights_are_refused(hr_weights, tmp_path):
    (tmp_path / "w.safetensors").write_bytes(hr_weights.read_bytes()[:-100])
    (tmp_path / "w.json").write_bytes(hr_weights.with_suffix(".json").read_bytes())
    with pytest.raises(InputError, match=r"w\.safetensors: "):
        export.export_onnx(tmp_path / "w.safetensors", tmp_path / "depth.onnx")
    assert not (tmp_path / "depth.onnx").exists()


def test_a_card_of_a_size_that_the_network_cannot_see_is_refused(hr_weights, tmp_path):
    (tmp_path / "w.safetensors").write_bytes(hr_weights.read_bytes())
    card = json.loads(hr_weights.with_suffix(".json").read_text()) | {"hr_size": [33, 33]}
    (tmp_path / "w.json").write_text(json.dumps(card))
    with pytest.raises(InputError, match=r"w\.safetensors: its network cannot see images of its card's \(33, 33\)"):
        export.export_onnx(tmp_path / "w.safetensors", tmp_path / "depth.onnx")


@pytest.mark.parametrize("missing", ["onnx", "onnxscript"])
def test_without_the_packages_it_says_how_to_get_them(hr_weights, tmp_path, monkeypatch, missing):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == missing else find(name))
    with pytest.raises(InputError, match=f"package {missing} is not installed; `pip install onnx onnxscript onnxruntime`"):
        export.export_onnx(hr_weights, tmp_path / "depth.onnx")


@pytest.mark.usefixtures("written_already")
def test_without_onnx_runtime_it_is_written_and_said_not_to_be_compared(hr_weights, tmp_path, monkeypatch, capsys):
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None if name == "onnxruntime" else find(name))
    assert main(["export", "--to", "onnx", "--weights", str(hr_weights), "--out", str(tmp_path / "depth.onnx")]) == 0
    assert "not compared with PyTorch: onnxruntime is not installed; `pip install onnxruntime` brings it" in capsys.readouterr().out
    with pytest.raises(InputError, match="package onnxruntime is not installed; `pip install onnxruntime`"):
        load_onnx(tmp_path / "depth.onnx")


def test_what_pip_is_told_to_install_is_the_group_export():
    groups = tomllib.loads((project_root() / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    assert [line.partition(">=")[0] for line in groups["export"]] == ["onnx", "onnxscript", "onnxruntime"]


def test_what_is_exported_takes_the_frame_itself(save):
    depth_net = load_depth_net(save(network="lr"))
    image = torch.from_numpy(made_up_images(SIZE, 1)[0])[None]
    averaged = image.reshape(1, 3, SIZE[0] // 3, 3, SIZE[1] // 3, 3).mean((3, 5))
    with torch.inference_mode():
        assert torch.allclose(ImageToDisparity(depth_net)(image), depth_net.net(averaged).disparities[0], rtol=1e-4)
