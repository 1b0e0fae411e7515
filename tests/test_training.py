"""The training loop: it learns, it repeats itself to the bit, it goes on where it was killed, and it stops in one line."""

import json
import signal

import pytest
import torch
from accelerate.state import AcceleratorState
from small_training import STEPS, WIDE, equal, profile_of, quiet_torch, run, triplets  # noqa: F401

from dualdepth.device import has_bf16
from dualdepth.errors import InputError
from dualdepth.training.checkpoints import checkpoint_paths
from dualdepth.training.log import read_log
from dualdepth.training.loop import train
from dualdepth.training.stages import Stage

# ruff: noqa: F811

BF16 = pytest.param("bf16", marks=pytest.mark.skipif(not has_bf16(torch.device("cpu")), reason="this CPU only imitates bf16"))


@pytest.mark.slow
def test_it_learns_one_triplet(run, profile_of, triplets, tmp_path):
    profile = profile_of(
        training={"log_every": 25, "checkpoint_every": 1000},
        stage={"epochs": 25, "learning_rates": [[1, 1e-3]]},
        augmentation={"max_scale": 1.0},
    )
    run(profile=profile, given=triplets[1:2])
    log = read_log(tmp_path / "run/log.csv")
    first, last = log.iloc[0], log.iloc[-1]
    assert list(log["step"]) == [1, 25]
    assert last["photometric"] < 0.5 * first["photometric"]
    assert last["loss"] < first["loss"]
    assert last["valid_share"] > 0.8  # not by looking away


@pytest.mark.slow
@pytest.mark.parametrize("precision", ["float32", BF16])
def test_two_runs_with_one_seed_are_equal_to_the_bit_and_another_seed_is_not(run, profile_of, tmp_path, precision):
    def profile(workers):
        return profile_of(training={"precision": precision, "workers": workers}, hr_size=WIDE)

    first, second = run("a", profile=profile(0)), run("b", profile=profile(1))
    assert equal(first, second)
    assert (tmp_path / "a/model.safetensors").read_bytes() == (tmp_path / "b/model.safetensors").read_bytes()
    assert not equal(first, run("c", profile=profile(0), seed=1))


def test_a_finished_run_leaves_weights_with_their_card_a_log_and_a_picture(run, tmp_path):
    run()
    folder = tmp_path / "run"
    card = json.loads((folder / "model.json").read_text())
    assert {k: card[k] for k in ("is", "seed", "recipe", "steps", "resumed_at")} == {
        "is": "x",
        "seed": 0,
        "recipe": "r",
        "steps": STEPS,
        "resumed_at": 0,
    }
    assert not checkpoint_paths(folder)
    assert (folder / f"panels/step_{STEPS:07d}.png").stat().st_size > 1000
    assert list((folder / "tensorboard").iterdir())
    log = read_log(folder / "log.csv")
    assert list(log["step"]) == list(range(1, STEPS + 1))
    # 6 steps stretch the paper's 40 epochs: 1.5 steps each at the first two rates
    assert log["learning_rate"].tolist() == [2e-4, 2e-4, 1e-4, 5e-5, 5e-5, 5e-5]


def test_too_few_triplets_are_an_error(run, profile_of):
    with pytest.raises(InputError, match="3 training triplets are fewer than a batch of 4"):
        run(profile=profile_of(stage={"batch_size": 4}))


@pytest.mark.parametrize(
    "changes",
    [
        {"training": {"precision": "bf16"}, "hr_size": WIDE},
        {"training": {"channels_last": False}},
        {"training": {"accumulate": 2}, "stage": {"batch_size": 2}},
        {"loss": {"feature": 0}},
        {"loss": {"scales": 1}},
        {"loss": {"beyond_paper_automask": True}},
        {"augmentation": {"augment_first": False}},
        {"augmentation": {"beyond_paper_flip": True}},
    ],
    ids=str,
)
def test_every_switch_trains_and_shapes_the_weights(run, profile_of, changes):
    plain = {"stage": {"max_steps": 2} | changes.get("stage", {}), "hr_size": changes.get("hr_size", (192, 192))}
    weights = run("switched", profile=profile_of(**changes | plain))
    assert all(value.isfinite().all() for value in weights.values())
    if "channels_last" not in str(changes):
        AcceleratorState._reset_state(reset_partial_state=True)
        assert not equal(weights, run("plain", profile=profile_of(**plain)))


def test_the_signal_handler_before_a_training_is_there_again_after_it(run, profile_of):
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        run(profile=profile_of(stage={"max_steps": 1}))
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


def test_steps_of_a_batch_that_is_cut_in_parts_average_the_parts(profile_of, triplets, tmp_path):
    """Gradients of the parts are averaged, not added: else the step would grow with `accumulate`."""
    seen = []

    class Watched(Stage):
        def __init__(self, profile):
            super().__init__(profile)
            self.pose_net.layers[-1].bias.register_post_accumulate_grad_hook(lambda p: seen.append(p.grad.clone()))

        def forward(self, batch):
            output = super().forward(batch)
            bias = self.pose_net.layers[-1].bias.sum()
            return output._replace(losses=output.losses._replace(total=bias))  # gradient 1, whatever the batch

    for accumulate in (1, 3):
        profile = profile_of(training={"accumulate": accumulate}, stage={"batch_size": 3, "max_steps": 1})
        folder = tmp_path / f"run{accumulate}"
        train(Watched, profile.training.lr, profile, triplets, folder, seed=0, recipe="r", card={})
    assert torch.allclose(seen[-1], seen[0])
    assert torch.allclose(seen[0], torch.ones(12))
    assert len(seen) == 4
