"""Convolutions whose mirrored borders are as fast as the CPU allows under autocast, and repeatable on a GPU."""

from typing import Any

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from dualdepth.geometry import GPU


class Reflection(torch.autograd.Function):
    """Maps (B, C, H, W) with mirrored borders, for a GPU: there torch's own leaves channels-last, and its gradient adds up the pixels next
    to a corner in any order, so that no two trainings are the same."""

    @staticmethod
    def forward(ctx: Any, x: Tensor, padding: tuple[int, int, int, int]) -> Tensor:
        """Wider by `padding`, pixels to the left, right, top and bottom, which must be fewer than there are."""
        ctx.padding = padding
        for dim, before, after in ((3, *padding[:2]), (2, *padding[2:])):
            parts = [x.narrow(dim, 1, before), x, x.narrow(dim, x.shape[dim] - 1 - after, after)]
            x = torch.cat([part if part is x else turned(part, dim) for part in parts if part.shape[dim]], dim)
        return x

    @staticmethod
    def backward(ctx: Any, gradient: Tensor) -> tuple[Tensor, None]:
        """A border's gradient goes to the pixels that it mirrors: first that of rows, which hold the corners."""
        left, right, top, bottom = ctx.padding
        whole = gradient.clone()
        for dim, before, after in ((2, top, bottom), (3, left, right)):
            end = whole.shape[dim] - after
            whole.narrow(dim, before + 1, before).add_(turned(whole.narrow(dim, 0, before), dim))
            whole.narrow(dim, end - 1 - after, after).add_(turned(whole.narrow(dim, end, after), dim))
        return whole[:, :, top : whole.shape[2] - bottom, left : whole.shape[3] - right], None


def turned(x: Tensor, dim: int) -> Tensor:
    """Mirrored along a dimension; one pixel needs no copy."""
    return x.flip(dim) if x.shape[dim] > 1 else x


class Conv2d(nn.Conv2d):
    """`nn.Conv2d`, which on the CPU under autocast mirrors borders in the narrow type and filters each channel by itself in float32.

    torch's autocast has borders mirrored in float32, with two more passes over memory each way; and oneDNN takes four to six times as long
    for bf16 gradients of a filter for each channel as for those in float32. On a GPU borders are mirrored by `Reflection`.
    """

    def forward(self, x: Tensor) -> Tensor:
        """Maps of (B, C, H, W), in the type that autocast gives them."""
        if x.device.type == GPU and self.padding_mode == "reflect":
            padded = Reflection.apply(x, self._reversed_padding_repeated_twice)
            return F.conv2d(padded, self.weight, self.bias, self.stride, 0, self.dilation, self.groups)
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
