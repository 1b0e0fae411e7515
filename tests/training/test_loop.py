"""The training loop: it learns, it repeats itself to the bit, and it stops in one line that says where."""

import json
import multiprocessing
import signal
import time

import pandas as pd
import pytest
import torch
from accelerate.state import AcceleratorState
from small_kitti import DRIVE
from small_nets import equal
from small_training import STEPS, WIDE, at_forward

from dualdepth.data import loading
from dualdepth.data.kitti import read_image
from dualdepth.device import has_bf16
from dualdepth.errors import InputError
from dualdepth.profile import load_profile
from dualdepth.training import loop
from dualdepth.training.checkpoints import last_checkpoint
from dualdepth.training.loop import learning_rate, total_steps
from dualdepth.training.stages import Stage

BF16 = pytest.param("bf16", marks=pytest.mark.skipif(not has_bf16(torch.device("cpu")), reason="this CPU only imitates bf16"))

PLAIN = {}
"""Weights of trainings without a switch."""


@pytest.mark.slow
def test_it_learns_one_triplet(run, profile_of, triplets, tmp_path):
    profile = profile_of(
        training={"log_every": 25, "checkpoint_every": 1000},
        stage={"epochs": 25, "learning_rates": [[1, 1e-3]]},
        augmentation={"max_scale": 1.0},
    )
    run(profile=profile, given=triplets[1:2])
    log = pd.read_csv(tmp_path / "run/log.csv")
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


@pytest.mark.slow
def test_a_finished_run_leaves_weights_with_their_card_a_log_and_a_picture(run, tmp_path):
    run()
    folder = tmp_path / "run"
    card = json.loads((folder / "model.json").read_text())
    facts = {"is": "x", "seed": 0, "recipe": "r", "steps": STEPS, "resumed_at": 0, "precision": "float32", "batch_parts": 1}
    assert facts.items() <= card.items()
    assert card.keys() == facts.keys() | {"seconds_of_last_run", "device", "last_losses", "sha256"}
    assert (folder / f"panels/step_{STEPS:07d}.png").stat().st_size > 1000
    assert list((folder / "tensorboard").iterdir())
    log = pd.read_csv(folder / "log.csv")
    assert list(log["step"]) == list(range(1, STEPS + 1))
    # 6 steps stretch the paper's 40 epochs: 1.5 steps each at the first two rates
    assert log["learning_rate"].tolist() == [2e-4, 2e-4, 1e-4, 5e-5, 5e-5, 5e-5]


def test_a_corridor_that_leaves_no_steps_is_an_error(run, profile_of):
    with pytest.raises(InputError, match=r"corridor_steps 2 .* 2 steps"):
        run(profile=profile_of(training={"beyond_paper_corridor_steps": 2}, stage={"max_steps": 2}))


@pytest.mark.slow
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
        {"training": {"beyond_paper_corridor_steps": 1}},
    ],
    ids=str,
)
def test_every_switch_trains_and_shapes_the_weights(run, profile_of, changes):
    plain = {"stage": {"max_steps": 2} | changes.get("stage", {}), "hr_size": changes.get("hr_size", (192, 192))}
    weights = run("switched", profile=profile_of(**changes | plain))
    assert all(value.isfinite().all() for value in weights.values())
    if "channels_last" not in str(changes):
        AcceleratorState._reset_state(reset_partial_state=True)
        PLAIN[str(plain)] = PLAIN.get(str(plain)) or run("plain", profile=profile_of(**plain))
        assert not equal(weights, PLAIN[str(plain)])


@pytest.mark.slow
def test_where_a_step_cannot_be_compiled_training_goes_on_as_without(run, profile_of, monkeypatch, capsys):
    stances = []

    def compiled(forward, dynamic):
        def step(*batch):
            if not stances:
                raise torch._dynamo.exc.TorchDynamoException("no compiler")
            return forward(*batch)

        return step

    plain = run("plain", profile=profile_of())
    monkeypatch.setattr(torch, "compile", compiled)
    monkeypatch.setattr(torch.compiler, "set_stance", stances.append)
    assert equal(plain, run("compiled", profile=profile_of(training={"compile": True})))
    assert stances == ["force_eager"] and "no compiler" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("seconds", [0.0, 1.0])
def test_a_training_that_waits_for_frames_says_so(run, profile_of, monkeypatch, capsys, seconds):
    monkeypatch.setattr(loop, "WATCHED", STEPS - 1)
    monkeypatch.setattr(loading, "read_image", lambda path: time.sleep(seconds / 3) or read_image(path))
    run(profile=profile_of(training={"workers": 0}))
    assert ("of the time the training waits for frames; raise training.workers (now 0)" in capsys.readouterr().out) == (seconds > 0)


def test_the_learning_rate_steps_down_at_the_papers_epochs():
    stage, per_epoch = load_profile("paper").training.lr, 39_810 // 4
    total = total_steps(stage, 39_810)
    assert total == 40 * per_epoch == 398_080
    rates = {epoch: {learning_rate(stage, (epoch - 1) * per_epoch + s, total) for s in (0, 1, per_epoch - 1)} for epoch in range(1, 41)}
    assert all(rates[epoch] == {2e-4} for epoch in range(1, 11))
    assert all(rates[epoch] == {1e-4} for epoch in range(11, 21))
    assert all(rates[epoch] == {5e-5} for epoch in range(21, 41))


@pytest.mark.slow
def test_the_signal_handler_before_a_training_is_there_again_after_it(run, profile_of):
    before = signal.signal(signal.SIGTERM, signal.SIG_IGN)
    try:
        run(profile=profile_of(stage={"max_steps": 1}))
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGTERM, before)


@pytest.mark.slow
def test_steps_of_a_batch_that_is_cut_in_parts_average_the_parts(run, profile_of):
    """Gradients of the parts are averaged, not added: else the step would grow with `accumulate`."""
    seen = []

    class Watched(Stage):
        def __init__(self, *networks, low):
            super().__init__(*networks, low=low)
            self.pose_net.layers[-1].bias.register_post_accumulate_grad_hook(lambda p: seen.append(p.grad.clone()))

        def forward(self, batch, *phase):
            output = super().forward(batch, *phase)
            bias = self.pose_net.layers[-1].bias.sum()
            return output._replace(losses=output.losses._replace(total=bias))  # gradient 1, whatever the batch

    for accumulate in (1, 3):
        run(f"run{accumulate}", Watched, profile_of(training={"accumulate": accumulate}, stage={"batch_size": 3, "max_steps": 1}))
    assert torch.allclose(seen[-1], seen[0])
    assert torch.allclose(seen[0], torch.ones(12))
    assert len(seen) == 4


def break_loss(output):
    return output._replace(losses=output.losses._replace(total=output.losses.total * torch.nan))


def break_pose(output):
    """The loss is blind to it: its pixels count as unseen."""
    return output._replace(poses=output.poses * torch.nan)


def break_gradient(output):
    """A finite loss can have an infinite gradient."""
    total = output.losses.total
    total.register_hook(lambda gradient: gradient * torch.nan)
    return output._replace(losses=output.losses._replace(total=total))


@pytest.mark.slow
@pytest.mark.parametrize("number", [1, 4])
@pytest.mark.parametrize(("what", "event"), [("loss", break_loss), ("pose", break_pose), ("gradient", break_gradient)])
def test_what_is_not_finite_stops_with_step_and_frames_and_leaves_the_last_checkpoint(run, tmp_path, what, event, number):
    with pytest.raises(InputError, match=rf"run: {what} is nan at step {number}, frames {DRIVE}/image_02/000000000[123]; ") as error:
        run(kind=at_forward(number, event))
    assert "\n" not in str(error.value)
    saved = last_checkpoint(tmp_path / "run")
    assert (saved and saved["step"]) == {1: None, 4: 2}[number]
    assert saved is None or all(v.isfinite().all() for v in saved["model"].values())
    left = {path.name for path in (tmp_path / "run").iterdir()}
    assert left <= {"checkpoint_00000002.pt", "log.csv", "panels", "tensorboard"}


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 2])
def test_a_bad_image_stops_the_training_in_one_line_that_names_it_and_no_worker_stays(run, profile_of, kitti_root, workers, tmp_path):
    path = kitti_root / DRIVE / "image_02/data/0000000004.png"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"^\S*0000000004\.png: truncated \(500 bytes\); copy or download it again$"):
        run(profile=profile_of(training={"workers": workers}))
    assert not (tmp_path / "run/model.safetensors").exists()
    assert not multiprocessing.active_children()
