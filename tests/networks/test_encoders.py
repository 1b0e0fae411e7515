"""Encoders: strides, channels, padding, ImageNet weights from a folder, foreign backbones; all without network."""

import socket

import cv2
import numpy as np
import pytest
import torch
from small_nets import as_trained
from torch import nn
from torch.nn import functional as F

from dualdepth.errors import InputError
from dualdepth.networks.convolution import Conv2d
from dualdepth.networks.depth_nets import LRNet
from dualdepth.networks.encoders import IMAGENET_MEAN, lite0_weights, make_encoder

CHANNELS = {
    "resnet18": (64, 64, 128, 256, 512),
    "resnet50": (64, 256, 512, 1024, 2048),
    "mobilenet_v2": (16, 24, 32, 96, 320),
    "efficientnet_lite0": (16, 24, 40, 112, 320),
}
NAMES = [*(name for name in CHANNELS if name != "resnet50"), pytest.param("resnet50", marks=pytest.mark.slow)]


@pytest.fixture(autouse=True)
def no_network(monkeypatch):
    def refuse(*arguments, **_):
        raise AssertionError(f"the network was asked for {arguments[:2]}")

    monkeypatch.setattr(socket, "getaddrinfo", refuse)
    monkeypatch.setattr(socket.socket, "connect", refuse)


@pytest.mark.parametrize("name", NAMES)
def test_no_convolution_pads_with_zeros(name):
    padded = [m for m in LRNet(name).modules() if isinstance(m, nn.Conv2d) and m.kernel_size[0] > 1]
    assert len(padded) > 20
    modes = {(m.kernel_size[0] == 5, m.padding_mode) for m in padded}
    assert modes <= {(False, "reflect"), (True, "replicate")}, "5×5 kernels are too large to reflect the deepest maps"
    assert {type(m) for m in padded} == {Conv2d}, "which mirrors in the narrow type"


@pytest.mark.parametrize("name", NAMES)
def test_maps_have_strides_2_to_32_and_the_networks_channels_and_of_a_flat_image_are_flat_up_to_the_border(name):
    """Zeros beyond the border would show as a frame."""
    encoder = as_trained(make_encoder(name))
    with torch.inference_mode():
        maps = encoder(torch.tensor([0.9, 0.4, 0.1]).view(1, 3, 1, 1).expand(2, 3, 64, 96))
    assert encoder.channels == CHANNELS[name]
    assert [tuple(m.shape) for m in maps] == [(2, c, 64 // s, 96 // s) for c, s in zip(CHANNELS[name], (2, 4, 8, 16, 32))]
    for found in maps:
        assert found.abs().max() > 1e-3
        assert torch.allclose(found, found[..., :1, :1].expand_as(found), rtol=1e-3, atol=1e-4 * found.abs().max().item())


@pytest.mark.parametrize("name", NAMES)
def test_images_are_normalised_as_imagenet_weights_expect(name):
    encoder = as_trained(make_encoder(name))
    grey = torch.tensor(IMAGENET_MEAN if name != "efficientnet_lite0" else [127 / 255] * 3).view(1, 3, 1, 1).expand(1, 3, 64, 64)
    with torch.inference_mode():
        for found, expected in zip(encoder(grey), encoder.stages(torch.zeros(1, 3, 64, 64))):
            assert torch.allclose(found, expected, atol=1e-5)


def test_mobilenet_leaves_the_padding_to_its_convolutions():
    """`tf_padding` pads zeros in forward, before the convolution could mirror."""
    encoder = make_encoder("mobilenet_v2")
    assert not any(m.config.tf_padding for m in encoder.modules() if hasattr(m, "config"))
    assert {m.momentum for m in encoder.modules() if isinstance(m, nn.BatchNorm2d)} == {0.1}


def plain_lite0(images):
    """EfficientNet-Lite0 written down on the file's weights, with the zero padding they learned with: five maps, 1000 logits."""
    weights = iter(lite0_weights().values())

    def layer(x, kernel=1, stride=1, groups=1, relu=True):
        before = (kernel - stride) // 2
        x = F.pad(x, (before, kernel - stride - before) * 2)
        x = F.conv2d(x, next(weights), stride=stride, groups=groups)
        gamma, beta, mean, variance, _ = (next(weights) for _ in range(5))
        x = F.batch_norm(x, mean, variance, gamma, beta, eps=1e-3)
        return F.relu6(x) if relu else x

    x, maps, width = layer((255 * images - 127) / 128, 3, 2), [], 32
    blocks = [(1, 16, 1, 3), (6, 24, 2, 3), (6, 24, 1, 3), (6, 40, 2, 5), (6, 40, 1, 5), (6, 80, 2, 3), *[(6, 80, 1, 3)] * 2]
    blocks += [*[(6, 112, 1, 5)] * 3, (6, 192, 2, 5), *[(6, 192, 1, 5)] * 3, (6, 320, 1, 3)]
    for expansion, outputs, stride, kernel in blocks:
        inside = layer(x) if expansion > 1 else x
        y = layer(layer(inside, kernel, stride, groups=inside.shape[1]), relu=False)
        x, width = (x + y if stride == 1 and width == outputs else y), outputs
        maps.append(x)
    logits = F.linear(layer(x).mean((2, 3)), next(weights), next(weights))
    assert next(weights, None) is None
    return [maps[k] for k in (0, 2, 4, 10, 15)], logits


def traffic_light(size=224):
    """A picture of one: red, yellow, green on a dark box in front of a sky."""
    picture = np.full((size, size, 3), (150, 190, 230), np.uint8)
    cv2.rectangle(picture, (75, 10), (150, 205), (25, 28, 25), -1)
    for row, colour in ((45, (255, 40, 30)), (107, (60, 50, 20)), (170, (15, 50, 35))):
        cv2.circle(picture, (112, row), 26, colour, -1, cv2.LINE_AA)
    return torch.from_numpy(cv2.GaussianBlur(picture, (0, 0), 1)).permute(2, 0, 1)[None] / 255


def test_lite0_computes_what_its_weights_learned_to():
    """Stride, order, normalisation: with zeros beyond the border its maps are those of the classifier, which knows what it sees."""
    encoder, picture = make_encoder("efficientnet_lite0", pretrained=True).eval(), traffic_light()
    for module in encoder.modules():
        if isinstance(module, nn.Conv2d):
            module.padding_mode = "constant"
    with torch.inference_mode():
        expected, logits = plain_lite0(picture)
        found = encoder(picture)
    assert all(torch.allclose(a, b, rtol=1e-3, atol=1e-3) for a, b in zip(found, expected, strict=True))
    assert logits.argmax() == 920  # traffic light


def test_lite0s_weights_are_those_that_were_published(tmp_path):
    with pytest.raises(InputError, match=r"nowhere\.pth: sha256 None"):
        make_encoder("efficientnet_lite0", pretrained=str(tmp_path / "nowhere.pth"))
    other = tmp_path / "other.pth"
    torch.save({}, other)
    with pytest.raises(InputError, match=f"{other}: sha256"):
        make_encoder("efficientnet_lite0", pretrained=str(other))


@pytest.mark.parametrize("name", ["resnet18", "mobilenet_v2"])
def test_imagenet_weights_are_taken_from_a_local_folder(name, tmp_path):
    """Which holds what the hub does: a classifier, whose encoder's names have a prefix."""
    from transformers import MobileNetV2Config, MobileNetV2ForImageClassification, ResNetConfig, ResNetForImageClassification

    config = ResNetConfig(depths=[2, 2, 2, 2], hidden_sizes=[64, 128, 256, 512], layer_type="basic")
    donor = ResNetForImageClassification(config) if name == "resnet18" else MobileNetV2ForImageClassification(MobileNetV2Config())
    as_trained(donor).save_pretrained(tmp_path)
    torch.manual_seed(6)
    encoder = make_encoder(name, pretrained=str(tmp_path))
    given = {k.split(".", 1)[1]: v for k, v in donor.state_dict().items() if not k.startswith("classifier")}
    taken = {k.removeprefix("backbone."): v for k, v in encoder.state_dict().items()}
    if name == "mobilenet_v2":
        taken = {k.replace("stem.", "conv_stem.", 1).replace("layers.", "layer.", 1): v for k, v in taken.items()}
    assert len(taken) > 100
    assert all(torch.equal(given[k], v) for k, v in taken.items())


def test_weights_that_cannot_be_had_are_a_one_line_error(tmp_path):
    with pytest.raises(InputError, match="nowhere' cannot be loaded") as error:
        make_encoder("resnet18", pretrained=str(tmp_path / "nowhere"))
    assert "pretrained: false" in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.slow
def test_weights_of_another_network_are_an_error(tmp_path):
    """Else the encoder would silently keep its random weights."""
    from transformers import ResNetConfig, ResNetModel, SwinForImageClassification

    narrow = ResNetConfig(depths=[2, 2, 2, 2], hidden_sizes=[8, 8, 8, 8], embedding_size=8, layer_type="basic")
    ResNetModel(narrow).save_pretrained(tmp_path / "narrow")
    SwinForImageClassification(tiny_config("swin")).save_pretrained(tmp_path / "swin")
    for folder, encoder in (("narrow", "resnet18"), ("swin", "resnet18"), ("narrow", "mobilenet_v2")):
        with pytest.raises(InputError, match=folder):
            make_encoder(encoder, pretrained=str(tmp_path / folder))


def tiny_config(kind):
    from transformers import ConvNextConfig, ConvNextV2Config, SwinConfig

    if kind == "swin":
        return SwinConfig(image_size=64, embed_dim=8, depths=[1, 1, 1, 1], num_heads=[1, 1, 2, 2], window_size=4)
    config = {"convnext": ConvNextConfig, "convnextv2": ConvNextV2Config}[kind]
    return config(hidden_sizes=[8, 16, 24, 32], depths=[1, 1, 1, 1])


@pytest.mark.parametrize("kind", ["swin", "convnext", "convnextv2"])
def test_any_hierarchical_backbone_is_an_encoder_without_a_stride_2_map(kind, tmp_path):
    tiny_config(kind).save_pretrained(tmp_path)
    net = LRNet(str(tmp_path)).eval()
    with torch.inference_mode():
        maps = net.encoder(torch.rand(1, 3, 128, 416))
        output = net(torch.rand(1, 3, 128, 416))
    assert maps[0] is None
    assert net.encoder.channels[0] is None
    assert [m.shape[-2:] for m in maps[1:]] == [(128 // s, 416 // s) for s in (4, 8, 16, 32)]
    assert [d.shape[-2:] for d in output.disparities] == [(128, 416), (64, 208), (32, 104), (16, 52)]


def test_weights_of_a_backbone_are_taken_from_its_folder(tmp_path):
    from transformers import SwinForImageClassification

    donor = SwinForImageClassification(tiny_config("swin"))
    donor.save_pretrained(tmp_path)
    encoder = make_encoder(str(tmp_path), pretrained=True)
    name = "embeddings.patch_embeddings.projection.weight"
    taken = next(value for key, value in encoder.state_dict().items() if key.endswith(name))
    assert torch.equal(taken, donor.swin.state_dict()[name])


def test_a_backbone_of_one_scale_and_a_folder_that_holds_no_network_are_refused(tmp_path):
    from transformers import Dinov2Config

    Dinov2Config(hidden_size=16, num_hidden_layers=4, num_attention_heads=2, image_size=64, patch_size=16).save_pretrained(tmp_path)
    with pytest.raises(InputError, match="a hierarchical backbone with 4, 8, 16, 32 is needed"):
        make_encoder(str(tmp_path))
    (tmp_path / "config.json").write_text("{}")
    with pytest.raises(InputError, match="not resnet50, resnet18, mobilenet_v2, efficientnet_lite0 nor a usable AutoBackbone"):
        make_encoder(str(tmp_path))
