"""LR-Net's encoders, from `transformers`: ResNet50, ResNet18, MobileNetV2, or any hierarchical AutoBackbone.

Every encoder maps images (B, 3, H, W) in [0, 1] to five maps at strides 2, 4, 8, 16, 32; a backbone without a stride-2 map
gives None there. Reflection padding replaces zero padding (paper, "Implementation Details").
"""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from dualdepth.errors import InputError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
HUB_NAMES = {"resnet50": "microsoft/resnet-50", "resnet18": "microsoft/resnet-18", "mobilenet_v2": "google/mobilenet_v2_1.0_224"}


class Encoder(nn.Module):
    """Base: normalises the image as ImageNet's weights expect; subclasses give `channels` and `stages`."""

    channels: tuple[int | None, int, int, int, int]

    def __init__(self) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(IMAGENET_MEAN).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(IMAGENET_STD).view(1, 3, 1, 1), persistent=False)

    def forward(self, image: Tensor) -> list[Tensor | None]:
        """Feature maps at strides 2, 4, 8, 16, 32 of an image (B, 3, H, W) in [0, 1]; H and W multiples of 32."""
        return self.stages((image - self.mean) / self.std)

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """The five maps of a normalised image."""
        raise NotImplementedError


class ResNetEncoder(Encoder):
    """ResNet18 or ResNet50 without classifier (He et al. 2016)."""

    def __init__(self, depth: int, pretrained: bool | str = False) -> None:
        from transformers import ResNetBackbone, ResNetConfig

        super().__init__()
        widths = {18: (64, 128, 256, 512), 50: (256, 512, 1024, 2048)}[depth]
        kind, blocks = {18: ("basic", [2, 2, 2, 2]), 50: ("bottleneck", [3, 4, 6, 3])}[depth]
        config = ResNetConfig(depths=blocks, hidden_sizes=list(widths), layer_type=kind)
        if pretrained:
            self.backbone = _from_hub(ResNetBackbone, HUB_NAMES[f"resnet{depth}"] if pretrained is True else pretrained, config=config)
        else:
            self.backbone = ResNetBackbone(config)
        self.channels = (64, *widths)
        reflect_padding(self)

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """Stride 2 is the first convolution's output: `ResNetBackbone` itself gives its stem only after the max-pool."""
        stem = self.backbone.embedder.embedder(image)
        maps, x = [stem], self.backbone.embedder.pooler(stem)
        for stage in self.backbone.encoder.stages:
            x = stage(x)
            maps.append(x)
        return maps


class MobileNetV2Encoder(Encoder):
    """MobileNetV2 up to its last block, without the final 320 → 1280 layer (Sandler et al. 2018)."""

    channels = (16, 24, 32, 96, 320)
    last_layers = (1, 4, 11, 15)
    """Index of the block that ends strides 4, 8, 16, 32."""

    def __init__(self, pretrained: bool | str = False) -> None:
        from transformers import MobileNetV2Config, MobileNetV2Model

        super().__init__()
        if pretrained:
            model = _from_hub(MobileNetV2Model, HUB_NAMES["mobilenet_v2"] if pretrained is True else pretrained, config=MobileNetV2Config())
        else:
            model = MobileNetV2Model(MobileNetV2Config(), add_pooling_layer=False)
        self.stem, self.layers = model.conv_stem, model.layer
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.momentum = 0.1  # transformers hands TensorFlow's decay 0.997 on, which here means the opposite
            if hasattr(module, "config"):
                module.config.tf_padding = False  # else zeros are padded in forward, before the convolution
            if isinstance(module, nn.Conv2d):
                module.padding = tuple((k - 1) // 2 for k in module.kernel_size)
        reflect_padding(self)

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """Maps just before each stride-2 block, and the last block's."""
        x = self.stem(image)
        maps = [x]
        for index, layer in enumerate(self.layers):
            x = layer(x)
            if index in self.last_layers:
                maps.append(x)
        return maps


class BackboneEncoder(Encoder):
    """Any hierarchical `AutoBackbone` with strides 4, 8, 16, 32, by hub name or local folder; it has no stride-2 map."""

    def __init__(self, name: str, pretrained: bool | str = False) -> None:
        from transformers import AutoBackbone, AutoConfig

        super().__init__()
        try:
            config = AutoConfig.from_pretrained(name)
            config.out_features = config.stage_names[-4:]
            self.backbone = AutoBackbone.from_config(config)
        except (OSError, ValueError, AttributeError) as error:
            raise InputError(f"encoder {name!r}: not resnet50, resnet18, mobilenet_v2 nor a usable AutoBackbone ({error})") from None
        if pretrained:  # by its own class: AutoBackbone asks the hub even about a local folder
            self.backbone = _from_hub(type(self.backbone), name if pretrained is True else pretrained, config=config)
        reflect_padding(self)
        with torch.no_grad():
            strides = [128 / m.shape[-1] for m in self.backbone.eval()(torch.zeros(1, 3, 128, 128)).feature_maps]
        self.backbone.train()
        if strides != [4, 8, 16, 32]:
            raise InputError(f"encoder {name!r}: its maps have strides {strides}; a hierarchical backbone with 4, 8, 16, 32 is needed")
        self.channels = (None, *self.backbone.channels)

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """The backbone's four maps, after a None for stride 2."""
        return [None, *self.backbone(image).feature_maps]


def make_encoder(name: str, pretrained: bool | str = False) -> Encoder:
    """Build an encoder.

    Args:
        name: `resnet50`, `resnet18`, `mobilenet_v2`, or the hub name or local folder of a hierarchical AutoBackbone.
        pretrained: False needs no network; True takes ImageNet weights from the hub or its cache; a string names the local
            folder (or hub name) to take them from.

    Raises:
        InputError: an unknown name, or weights that cannot be had.
    """
    if name.startswith("resnet") and name in HUB_NAMES:
        return ResNetEncoder(int(name.removeprefix("resnet")), pretrained)
    if name == "mobilenet_v2":
        return MobileNetV2Encoder(pretrained)
    return BackboneEncoder(name, pretrained)


def reflect_padding(module: nn.Module) -> None:
    """Replace zero padding by reflection in every convolution of `module`."""
    for child in module.modules():
        if isinstance(child, nn.Conv2d) and any(_as_pair(child.padding)):
            child.padding_mode = "reflect"
            top, left = _as_pair(child.padding)
            child._reversed_padding_repeated_twice = [left, left, top, top]


def _as_pair(padding: str | Sequence[int]) -> tuple[int, int]:
    if isinstance(padding, str):
        return (0, 0)
    return tuple(padding)


def _from_hub(cls: type, name: str, **options: Any) -> nn.Module:
    """Pretrained model; transformers alone would give random weights where the file has none."""
    try:
        model, loaded = cls.from_pretrained(name, output_loading_info=True, **options)
        missing = sorted(key for key in loaded["missing_keys"] if "hidden_states_norms" not in key)  # a backbone's own, after each stage
        if missing:
            raise ValueError(f"it has no {missing[0]}: weights of another network")
        return model
    except (OSError, ValueError, RuntimeError) as error:
        reason = str(error).splitlines()[0]
        raise InputError(
            f"ImageNet weights {name!r} cannot be loaded ({reason}); "
            "set `pretrained: false`, or give a local folder with config.json and model.safetensors"
        ) from None
