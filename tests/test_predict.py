"""Predictions from files: of the right size, in the files' order, and of exactly the view that training had."""

import cv2
import numpy as np
import pytest
import torch
from small_kitti import wall

from dualdepth.checkpoints import save_weights
from dualdepth.errors import InputError
from dualdepth.networks.lr_net import LRNet
from dualdepth.predict import load_depth_net, predict_disparities

SIZE = (192, 288)


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("images")
    paths = [folder / f"{i}.png" for i in range(3)]
    for i, path in enumerate(paths):
        cv2.imwrite(str(path), wall(*SIZE, seed=i))
    return paths


@pytest.fixture(scope="module")
def net():
    torch.manual_seed(0)
    return LRNet("mobilenet_v2").eval()


def test_maps_have_the_networks_size_and_the_files_order(net, files):
    together = predict_disparities(net, files, SIZE, batch_size=2)
    assert together.shape == (3, 64, 96)
    assert together.dtype == np.float32
    for one, path in zip(together, files):
        np.testing.assert_allclose(one, predict_disparities(net, [path], SIZE)[0], rtol=1e-4)


def test_the_network_sees_the_image_averaged_3_by_3(net, files):
    image = cv2.imread(str(files[0]))[..., ::-1].astype(np.float32) / 255
    low = image.reshape(64, 3, 96, 3, 3).mean((1, 3)).transpose(2, 0, 1)
    with torch.inference_mode():
        expected = net(torch.from_numpy(np.ascontiguousarray(low))[None], scales=1).disparities[0][0, 0]
    np.testing.assert_allclose(predict_disparities(net, files[:1], SIZE)[0], expected, rtol=1e-4)


def test_released_weights_give_their_network_back(net, files, tmp_path):
    path = tmp_path / "model.safetensors"
    whole = torch.nn.ModuleDict({"depth_net": net, "pose_net": torch.nn.Linear(1, 1)})
    save_weights(path, whole, {"network": {"encoder": "mobilenet_v2", "hr_size": list(SIZE)}})
    loaded, size = load_depth_net(path)
    assert size == SIZE
    assert np.array_equal(predict_disparities(loaded, files[:1], size), predict_disparities(net, files[:1], SIZE))


def test_a_card_without_a_network_is_an_error_that_names_it(net, tmp_path):
    save_weights(tmp_path / "model.safetensors", net, {"about": "x"})
    with pytest.raises(InputError, match=r"model\.json: names no network"):
        load_depth_net(tmp_path / "model.safetensors")
