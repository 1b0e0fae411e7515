"""Trainings of a small LR-Net on a few frames: fixtures and events that tests of the loop share."""

import os
import signal

import pandas as pd
import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors.torch import load_file
from small_kitti import triplets_of

from dualdepth.networks.depth_nets import LRNet
from dualdepth.networks.pose_net import make_pose_net
from dualdepth.profile import load_profile
from dualdepth.training.loop import Trainer
from dualdepth.training.stages import Stage
from tests.small_checkout import write_profile

STEPS = 6
WHOLE = {}
WIDE = (192, 288)
"""For bfloat16: at 192×192 PoseNet's last map is 1×1, where the CPU leaves the gradient of padded weights unset."""


@pytest.fixture(autouse=True)
def quiet_torch():
    """Each training decides precision and determinism for itself."""
    yield
    AcceleratorState._reset_state(reset_partial_state=True)
    torch.use_deterministic_algorithms(False)


@pytest.fixture
def profile_of(encoder, tmp_path):
    """A profile for tiny trainings, with changes like `training={"workers": 1}` or `stage={"epochs": 3}`."""

    def make(training=None, stage=None, loss=None, augmentation=None, hr_size=(192, 192)):
        stages = {"lr": {"epochs": 2, "batch_size": 1} | (stage or {}), "loss": loss or {}, "augmentation": augmentation or {}}
        return load_profile(write_profile(tmp_path / "own.yaml", encoder, (training or {}) | stages, hr_size))

    return make


@pytest.fixture
def triplets(kitti_root, tmp_path):
    """Three triplets of five frames."""
    return triplets_of(kitti_root, tmp_path)


@pytest.fixture
def run(profile_of, triplets, tmp_path):
    """Trains stage 1 in a folder of its own; gives the weights. `kind` is the class of the stage."""

    def call(folder="run", kind=Stage, profile=None, seed=0, recipe="r", given=None):
        profile = profile or profile_of()
        settings = profile.training

        def make():
            return kind(LRNet(settings.encoder, settings.pretrained), make_pose_net(settings.beyond_paper_pose_encoder), settings, low=True)

        trainer = Trainer(make, settings.lr, profile, given or triplets, tmp_path / folder, seed=seed, recipe=recipe)
        path = trainer.run({"is": "x"})
        assert path == tmp_path / folder / "model.safetensors"
        return load_file(path)

    return call


@pytest.fixture
def whole_and_log(run, request, tmp_path):
    """Weights and log of the module's undisturbed training, trained once, since they are the same for each test."""
    if request.module not in WHOLE:
        WHOLE[request.module] = run("whole"), log_of(tmp_path / "whole")
    return WHOLE[request.module]


@pytest.fixture
def whole(whole_and_log):
    """The weights alone."""
    return whole_and_log[0]


def log_of(folder):
    """A training's log without its speed."""
    return pd.read_csv(folder / "log.csv").drop(columns="steps_per_second")


def at_forward(number, event, kind=Stage):
    """A stage that calls `event(output)` on its forward with this number, and gives what that returns."""

    class Disturbed(kind):
        calls = 0

        def forward(self, batch, *phase):
            output = super().forward(batch, *phase)
            Disturbed.calls += 1
            return (event(output) or output) if Disturbed.calls == number else output

    return Disturbed


def kill_softly(_):
    os.kill(os.getpid(), signal.SIGTERM)


def kill(_):
    raise KeyboardInterrupt
