"""Frames and networks that say nothing: both stages, whole, survive them with finite losses and gradients of all weights."""

import pytest
import torch
from small_stages import batch_of, stage_of

from dualdepth.networks.depth_nets import LRNet
from dualdepth.networks.pose_net import POSE_SCALE, PoseNet

pytestmark = pytest.mark.slow


def pixels(value):
    return lambda stage, batch: batch["images"].fill_(value)


def still(stage, batch):
    batch["images"][:, 1:] = batch["images"][:, :1]
    move(0, 0.0)(stage, batch)


def move(axis, value):
    """All poses have this translation or angle on one axis, and nothing else."""

    def change(stage, batch):
        last = stage.pose_net.layers[-1]
        torch.nn.init.zeros_(last.weight)
        torch.nn.init.zeros_(last.bias)
        last.bias.data[axis::6] = value / POSE_SCALE

    return change


def decoder(stage):
    """Of the network that gives the stage's depth."""
    return getattr(stage.depth_net, "hr_net", stage.depth_net).decoder


def disparity(bias):
    def change(stage, batch):
        for head in decoder(stage).heads:
            head.bias.data.fill_(bias)

    return change


def constant(stage, batch):
    for weight in (value for name, value in decoder(stage).merge.named_parameters() if name.endswith("weight")):
        torch.nn.init.zeros_(weight)


CASES = {
    "black frames": pixels(0),
    "white frames": pixels(255),
    "no motion": still,
    "depth at its nearest": disparity(1e4),
    "depth at its farthest": disparity(-1e4),
    "points behind the camera": move(2, -1e3),
    "no valid pixel": move(0, 1e6),
    "half a turn": move(4, 3.14159),
    "constant features": constant,
}


@pytest.mark.parametrize("name", ["lr", "lr with automask", "hr"])
@pytest.mark.parametrize("case", CASES)
def test_losses_and_gradients_of_a_whole_stage_stay_finite(case, name, dual_of, encoder, counted):
    torch.manual_seed(0)
    depth_net = dual_of() if name == "hr" else LRNet(encoder)
    stage = stage_of(depth_net, PoseNet(), low=name != "hr", beyond_paper_automask="automask" in name).train()
    batch = batch_of(1, (192, 192))
    CASES[case](stage, batch)
    with counted():
        output = stage(batch)
        output.losses.total.backward()
        assert output.losses.total.isfinite()
        if case == "no valid pixel":
            assert output.losses.valid_share == 0
        gradients = [p.grad for p in stage.parameters() if p.grad is not None]
        assert gradients and all(gradient.isfinite().all() for gradient in gradients)
