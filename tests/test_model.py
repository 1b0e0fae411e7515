"""`load(weights)` and its `predict` and `disparities`: of exactly the view that training had, at the image's or the network's size."""

import json
import shutil
from typing import get_args

import cv2
import huggingface_hub
import numpy as np
import pytest
import torch
from small_kitti import wall
from small_nets import averaged, output_of, with_heads
from torch import nn

import dualdepth
from dualdepth.data.frames import resample
from dualdepth.model import DepthModel
from dualdepth.networks.architecture import Architecture, Network
from dualdepth.networks.depth_nets import DualNet, HRNet, LRNet
from dualdepth.training.weights import save_weights

SIZE = (192, 288)
NETWORKS = get_args(Network)
CLASSES = {"lr": LRNet, "single": LRNet, "dual": DualNet, "hr": HRNet}
ABOUT = "a net, trained on 7 triplets: a test world"
CARD = {"network": "hr", "hr_size": list(SIZE), "about": ABOUT, "drives": ["a/b"], "device": "AMD EPYC, 2 threads", "precision": "bf16"}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    paths = [folder / f"{i}.png" for i in range(3)]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), wall(*SIZE, seed=i))
    return paths


@pytest.fixture(scope="module")
def model_of(encoder):
    """A depth model with new weights."""

    def make(network, **settings):
        torch.manual_seed(0)
        words = Architecture(network=network, encoder=encoder, **settings).model_dump()
        return DepthModel(CARD | words, with_heads(Architecture(**words).build()), device="cpu")

    return make


@pytest.fixture(scope="module")
def model(model_of):
    return model_of("hr")


@pytest.fixture
def save(model_of, tmp_path):
    """Saves weights as a training does, with changes of their card (None leaves a key out); gives their path."""

    def call(of="lr", **changes):
        whole = nn.ModuleDict({"depth_net": (model := model_of(of)).depth_net, "pose_net": nn.Linear(1, 1)})
        card = model.card | changes
        save_weights(tmp_path / "model.safetensors", whole, {key: value for key, value in card.items() if value is not None})
        return tmp_path / "model.safetensors"

    return call


@pytest.fixture
def folder(model, tmp_path):
    """Weights with their card, as `save_pretrained` writes them."""
    model.save_pretrained(tmp_path / "weights")
    return tmp_path / "weights"


class Seen(nn.Module):
    """Stands for a depth network and notes what it is given."""

    def forward(self, image, scales=4):
        found = nn.functional.conv2d(image, torch.full((1, 3, 1, 1), 1 / 3))
        self.image, self.scales, self.dtype = image, scales, found.dtype
        return output_of([found], image)


@pytest.mark.parametrize("network", NETWORKS)
def test_disparities_are_the_networks_finest_in_the_files_order(model_of, files, network):
    model = model_of(network)
    together = model.train().disparities(files, batch_size=2)  # whose batch norm is that of the weights all the same
    assert together.dtype == np.float32 and not np.allclose(together[0], together[1], rtol=1e-4)
    for one, path in zip(together, files, strict=True):
        image = torch.from_numpy(cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255).permute(2, 0, 1)[None]
        with torch.inference_mode():
            expected = model.depth_net(averaged(image) if network == "lr" else image).disparities[0][0, 0]
        np.testing.assert_allclose(one, expected, rtol=1e-4)
        assert one.shape == ((64, 96) if network == "lr" else SIZE)


@pytest.mark.parametrize("network", NETWORKS)
def test_lr_net_sees_the_resized_image_averaged_3_by_3_and_the_others_see_it_whole(network):
    seen, wide = Seen(), wall(250, 700)
    found = DepthModel(CARD | {"network": network}, seen, device="cpu").disparities(["wide"], read=lambda path: wide)
    image = torch.from_numpy(resample(wide, SIZE).transpose(2, 0, 1)[None] / np.float32(255))
    expected = averaged(image) if network == "lr" else image
    assert seen.image.shape == expected.shape and seen.scales == 1
    assert torch.allclose(seen.image, expected, atol=1e-6)
    np.testing.assert_allclose(found[0], expected[0].mean(0), atol=1e-6)


@pytest.mark.parametrize("network", NETWORKS)
def test_released_weights_give_their_network_back(model_of, save, files, network):
    given, path = model_of(network), save(network)
    for name in (path, str(path), path.parent):
        loaded = dualdepth.load(name, "cpu")
        assert type(loaded.depth_net) is CLASSES[network]
        assert not any(module.training for module in loaded.modules())
        assert (loaded.architecture, loaded.size) == (given.architecture, SIZE)
        assert np.array_equal(loaded.disparities(files[:1]), given.disparities(files[:1]))


@pytest.mark.parametrize("changes", [{"link": "embedding"}, {"similarity": "cosine"}, {"normalise": "softmax"}], ids=str)
def test_what_sa_attention_does_is_read_from_the_card(save, changes):
    attention = dualdepth.load(save("dual", **changes)).depth_net.attention
    found = {"link": "attention" if attention.mixing else "embedding", "similarity": attention.similarity, "normalise": attention.normalise}
    assert found == {"link": "attention", "similarity": "dot", "normalise": "none"} | changes


@pytest.mark.parametrize(
    "changes",
    [
        *({key: None} for key in ("network", "encoder", "link", "similarity", "normalise", "residual")),
        {"network": "triple"},
        {"network": {"encoder": "resnet50", "hr_size": [192, 288]}},  # an older card
        {"link": "wire"},
        *({"hr_size": size} for size in (None, 192, 5, [100, 288], [-192, 288], [192, 96 * 10**7])),
    ],
    ids=str,
)
def test_a_card_that_does_not_name_a_whole_network_of_this_project_is_refused_in_one_line(save, changes):
    with pytest.raises(dualdepth.InputError) as error:
        dualdepth.load(save(**changes))
    said = str(error.value)
    assert "\n" not in said and "model.json: " in said and next(iter(changes)) in said


@pytest.mark.parametrize(("network", "named"), [("lr", "dual"), ("dual", "lr"), ("dual", "hr"), ("hr", "dual"), ("single", "hr")])
def test_weights_that_are_not_of_the_cards_network_are_refused(save, network, named):
    with pytest.raises(dualdepth.InputError, match=r"model\.safetensors: weights of another network"):
        dualdepth.load(save(network, network=named))


def test_card_representation_and_hub_page_say_that_depth_is_relative_and_from_which_data(folder):
    card, model = json.loads((folder / "config.json").read_text()), dualdepth.load(folder, "cpu")
    assert card.items() >= (CARD | {"encoder": model.architecture.encoder}).items() and model.card == card
    assert model.about.startswith("Depth is relative") and ABOUT in model.about
    assert model.about in repr(model) and model.about in (folder / "README.md").read_text()
    assert "ImageNet" in DepthModel(CARD | {"pretrained": True}).about
    assert "does not say" in DepthModel({"network": "hr", "hr_size": [192, 288]}).about


@pytest.mark.parametrize("size", [(1, 1), (375, 1242), (700, 301), (2160, 3840)])
def test_depth_has_the_images_size_whatever_it_is(model, size):
    depth = model.predict(cv2.resize(wall(60, 80), size[::-1]))
    assert (depth.shape, depth.dtype) == (size, np.float32)
    assert (depth >= 1 / 10.01 * 0.999).all() and (depth <= 100.1).all()


def test_depth_is_what_is_scored(model, files):
    """The tables invert disparities and resize that bilinearly."""
    *together, other = model.predict_batch([*files, wall(200, 50, seed=1)])  # images of several sizes
    for found, disparity in zip(together, model.disparities(files), strict=True):
        np.testing.assert_allclose(found, cv2.resize(1 / disparity, SIZE[::-1]), rtol=1e-3)
    np.testing.assert_allclose(other, model.predict(wall(200, 50, seed=1)), rtol=1e-4)


@pytest.mark.parametrize(("shape", "kind"), [((4, 4), float), ((4, 4, 3), float), ((4, 4, 4), np.uint8), ((0, 4, 3), np.uint8)])
def test_arrays_that_are_no_images_are_refused(model, shape, kind):
    with pytest.raises(dualdepth.InputError, match=str(shape[0])):
        model.predict(np.zeros(shape, kind))


def test_a_name_on_the_hub_is_taken_from_its_cache_without_network_or_refused_in_one_line(folder, model, tmp_path, monkeypatch):
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_OFFLINE", True)
    monkeypatch.setattr(huggingface_hub.constants, "HF_HUB_CACHE", str(tmp_path))
    home = tmp_path / "models--some--net"
    shutil.copytree(folder, home / "snapshots" / "abc")
    (home / "refs").mkdir()
    (home / "refs" / "main").write_text("abc")
    found = DepthModel.from_pretrained("some/net", cache_dir=tmp_path, local_files_only=True, device="cpu")
    assert np.array_equal(found.predict(wall(60, 80)), model.predict(wall(60, 80)))
    for name in ("some/other", "no such/na me/at all"):
        with pytest.raises(dualdepth.InputError, match=f"^{name}: .*hub") as error:
            dualdepth.load(name)
        assert "\n" not in str(error.value)
    with pytest.raises(TypeError, match="devise"):
        DepthModel.from_pretrained(folder, devise="cpu")


def test_weights_that_are_not_finite_are_noticed():
    model = DepthModel(CARD, device="cpu")
    nn.init.constant_(next(model.parameters()), float("nan"))
    with pytest.raises(dualdepth.InputError, match="float32"):
        model.predict(wall(60, 80))


@pytest.mark.parametrize(("precision", "dtype"), [("float32", torch.float32), ("bf16", torch.bfloat16)])
def test_the_network_computes_in_the_precision_and_depth_is_float32(precision, dtype):
    seen = Seen()
    depth = DepthModel(CARD, seen, device="cpu", precision=precision).predict(wall(60, 80))
    assert (seen.dtype, depth.dtype) == (dtype, np.float32)
