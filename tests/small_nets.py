"""A network of a few weights, its equality, and a pickle that must not be opened: for whatever reads and writes weights."""

import torch
from torch import nn

from dualdepth.networks.decoder import Decoder, DepthOutput
from dualdepth.networks.pose_net import PoseNet


class Net(nn.Module):
    def __init__(self, width=3):
        super().__init__()
        self.depth_net = nn.Sequential(nn.Conv2d(1, width, 3), nn.BatchNorm2d(width))
        self.pose_net = nn.Linear(2, 2)


class Trap:
    """A pickle that leaves a mark when its code is run."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return open, (self.mark, "w")


def trained_net():
    """A network after one step, and its optimiser."""
    net = Net()
    optimizer = torch.optim.Adam(net.parameters())
    net.depth_net(torch.rand(2, 1, 5, 5)).sum().backward()
    optimizer.step()
    return net, optimizer


def with_heads(net):
    """With heads, and a last layer of PoseNet, that look at their features, as after some steps; they begin at zero."""
    for module in net.modules():
        for layer in module.heads if isinstance(module, Decoder) else [module.layers[-1]] if isinstance(module, PoseNet) else []:
            nn.init.xavier_uniform_(layer.weight)
    return net


def output_of(disparities, features):
    """A depth network's output with these disparities, between 0.01 and 10.01."""
    return DepthOutput([torch.logit((d - 0.01) / 10, eps=1e-7) for d in disparities], features)


def averaged(images):
    """Means over 3×3 pixels of (…, H, W)."""
    return images.double().unflatten(-1, (-1, 3)).unflatten(-3, (-1, 3)).mean((-1, -3)).float()


def as_trained(net):
    """In eval mode, with heads and batch norm statistics of a trained network, so that a zero at the border would show."""
    torch.manual_seed(0)
    with_heads(net)
    for module in net.modules():
        if isinstance(module, nn.BatchNorm2d):
            nn.init.normal_(module.running_mean, std=0.3)
            nn.init.uniform_(module.running_var, 0.5, 2)
            nn.init.normal_(module.bias, std=0.3)
    return net.eval()


def equal(a, b):
    """Whether two sets of tensors have the same names and bits, and some."""
    return len(a) > 0 and a.keys() == b.keys() and all(torch.equal(v, b[k]) for k, v in a.items())
