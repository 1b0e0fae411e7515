"""Predictions from files: of the right size, in the files' order, and of exactly the view that training had."""

from typing import get_args

import cv2
import numpy as np
import pytest
import torch
from small_kitti import wall
from small_nets import output_of, with_heads
from torch import nn

from dualdepth.data.frames import resample
from dualdepth.errors import InputError
from dualdepth.inference.predict import DepthNet, load_depth_net, predict_disparities
from dualdepth.networks.architecture import Architecture, Network
from dualdepth.networks.depth_nets import DualNet, HRNet, LRNet
from dualdepth.training.weights import save_weights

SIZE = (192, 288)
NETWORKS = get_args(Network)
CLASSES = {"lr": LRNet, "single": LRNet, "dual": DualNet, "hr": HRNet}


class Seen(nn.Module):
    """Stands for a depth network and notes what it is given."""

    def forward(self, image, scales=4):
        self.image, self.scales = image, scales
        return output_of([image.mean(1, keepdim=True)], image)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    paths = [folder / f"{i}.png" for i in range(3)]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), wall(*SIZE, seed=i))
    return paths


@pytest.fixture(scope="module")
def depth_net_of(encoder):
    """A depth network with new weights."""

    def make(network, **settings):
        torch.manual_seed(0)
        architecture = Architecture(network=network, encoder=encoder, **settings)
        return DepthNet(with_heads(architecture.build()).eval(), architecture, SIZE)

    return make


@pytest.fixture
def save(depth_net_of, tmp_path):
    """Saves weights as a training does, with changes of their card (None leaves a key out); gives their path."""

    def call(of="lr", **changes):
        net, architecture, size = depth_net_of(of)
        whole = nn.ModuleDict({"depth_net": net, "pose_net": nn.Linear(1, 1)})
        card = architecture.model_dump() | {"hr_size": list(size)} | changes
        save_weights(tmp_path / "model.safetensors", whole, {key: value for key, value in card.items() if value is not None})
        return tmp_path / "model.safetensors"

    return call


def pixels(path):
    """(1, 3, H, W) in [0, 1]."""
    return torch.from_numpy(cv2.imread(str(path))[..., ::-1].astype(np.float32) / 255).permute(2, 0, 1)[None]


def averaged(image):
    """3×3 means of (1, 3, H, W)."""
    return image.reshape(1, 3, SIZE[0] // 3, 3, SIZE[1] // 3, 3).mean((3, 5))


@pytest.mark.parametrize("network", NETWORKS)
def test_maps_are_the_networks_finest_disparities_in_the_files_order(depth_net_of, files, network):
    depth_net = depth_net_of(network)
    together = predict_disparities(depth_net, files, batch_size=2)
    assert together.dtype == np.float32 and not np.allclose(together[0], together[1], rtol=1e-4)
    for one, path in zip(together, files, strict=True):
        view = averaged(pixels(path)) if network == "lr" else pixels(path)
        with torch.inference_mode():
            expected = depth_net.net(view).disparities[0][0, 0]
        np.testing.assert_allclose(one, expected, rtol=1e-4)
        assert one.shape == ((64, 96) if network == "lr" else SIZE)


@pytest.mark.parametrize("network", NETWORKS)
def test_lr_net_sees_the_resized_image_averaged_3_by_3_and_the_others_see_it_whole(tmp_path, network):
    cv2.imwrite(str(tmp_path / "wide.png"), wall(250, 700))
    seen = Seen()
    found = predict_disparities(DepthNet(seen, Architecture(network=network), SIZE), [tmp_path / "wide.png"])
    image = resample(cv2.imread(str(tmp_path / "wide.png"))[..., ::-1], SIZE).transpose(2, 0, 1)[None] / np.float32(255)
    expected = averaged(torch.from_numpy(image)) if network == "lr" else torch.from_numpy(image)
    assert seen.image.shape == expected.shape and seen.scales == 1
    assert torch.allclose(seen.image, expected, atol=1e-6)
    np.testing.assert_allclose(found[0], expected[0].mean(0), atol=1e-6)


@pytest.mark.parametrize("network", NETWORKS)
def test_released_weights_give_their_network_back(depth_net_of, save, files, network):
    given, loaded = depth_net_of(network), load_depth_net(save(network))
    assert type(loaded.net) is CLASSES[network]
    assert not any(module.training for module in loaded.net.modules())
    assert (loaded.architecture, loaded.hr_size) == (given.architecture, SIZE)
    assert np.array_equal(predict_disparities(loaded, files[:1]), predict_disparities(given, files[:1]))


@pytest.mark.parametrize("changes", [{"link": "embedding"}, {"similarity": "cosine"}, {"normalise": "softmax"}], ids=str)
def test_what_sa_attention_does_is_read_from_the_card(save, changes):
    loaded = load_depth_net(save("dual", **changes))
    assert loaded.architecture == load_depth_net(save("dual")).architecture.model_copy(update=changes)
    attention = loaded.net.attention
    found = {"link": "attention" if attention.mixing else "embedding", "similarity": attention.similarity, "normalise": attention.normalise}
    assert found == {"link": "attention", "similarity": "dot", "normalise": "none"} | changes


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        *(({key: None}, f"'{key}'") for key in ("network", "encoder", "link", "similarity", "normalise")),
        ({"network": "triple"}, "network: .*'lr', 'single', 'dual' or 'hr'"),
        ({"network": {"encoder": "resnet50", "hr_size": [192, 288]}}, "network: "),  # an older card
        ({"link": "wire"}, "link: "),
        *(({"hr_size": size}, f"hr_size {size} is no") for size in (None, 192)),
    ],
    ids=str,
)
def test_a_card_that_does_not_name_a_whole_network_of_this_project_is_refused_in_one_line(save, changes, said):
    weights = save(**changes)
    with pytest.raises(InputError, match=rf"model\.json: names no network of this project \(.*{said}.*\)") as error:
        load_depth_net(weights)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(("network", "named"), [("lr", "dual"), ("dual", "lr"), ("dual", "hr"), ("hr", "dual"), ("single", "hr")])
def test_weights_that_are_not_of_the_cards_network_are_refused(save, network, named):
    weights = save(network, network=named)
    with pytest.raises(InputError, match=r"model\.safetensors: weights of another network"):
        load_depth_net(weights)
