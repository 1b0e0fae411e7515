"""Convolutions as fast as the CPU allows under autocast."""

import torch
from torch import Tensor, nn


class Conv2d(nn.Conv2d):
    """`nn.Conv2d`, which on the CPU under autocast mirrors borders in the narrow type and filters each channel by itself in float32.

    torch's autocast has borders mirrored in float32, with two more passes over memory each way; and oneDNN takes four to six times as long
    for bf16 gradients of a filter for each channel as for those in float32.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Maps of (B, C, H, W), in the type that autocast gives them."""
        if x.device.type != "cpu" or x.dtype == torch.float64 or not torch.is_autocast_enabled("cpu"):
            return super().forward(x)
        narrow = torch.get_autocast_dtype("cpu")
        dtype = torch.float32 if self.groups == self.in_channels > 1 else narrow
        with torch.autocast("cpu", enabled=False):
            bias = None if self.bias is None else self.bias.to(dtype)
            return self._conv_forward(x.to(dtype), self.weight.to(dtype), bias).to(narrow)


def conv3x3(inputs: int, outputs: int, stride: int = 1, bias: bool = True) -> Conv2d:
    """3×3 convolution with reflection padding."""
    return Conv2d(inputs, outputs, 3, stride, padding=1, padding_mode="reflect", bias=bias)


def reflect_padding(module: nn.Module) -> None:
    """Replace zero padding by reflection in every convolution of `module` that has its padding as numbers; it becomes a `Conv2d`."""
    for child in module.modules():
        if isinstance(child, nn.Conv2d) and any(child._reversed_padding_repeated_twice) and not isinstance(child.padding, str):
            child.padding_mode = "reflect"
            if type(child) is nn.Conv2d:
                child.__class__ = Conv2d  # with the weights that it has
