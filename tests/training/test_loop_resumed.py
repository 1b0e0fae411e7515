"""A training that was stopped or killed, or could not write, goes on as if nothing had been."""

import functools
from unittest.mock import Mock

import pandas as pd
import pytest
import torch
from small_nets import equal
from small_training import STEPS, WIDE, at_forward, kill, kill_softly, log_of

from dualdepth.training.checkpoints import last_checkpoint
from dualdepth.training.loop import Trainer
from dualdepth.training.stages import Stage
from dualdepth.training.weights import load_card

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("number", [1, STEPS])
def test_a_run_that_was_told_to_stop_goes_on_to_the_same_weights(run, whole, tmp_path, number):
    with pytest.raises(SystemExit, match=f"stopped at step {number} of {STEPS}"):
        run("cut", kind=at_forward(number, kill_softly))
    assert last_checkpoint(tmp_path / "cut")["step"] == number
    assert equal(run("cut"), whole)


@pytest.mark.parametrize(
    ("more", "rates"),
    [({}, [1e-3, 1e-3, 1e-4]), ({"beyond_paper_pose_encoder": "efficientnet_lite0", "beyond_paper_average": 0.6}, [2e-4, 2e-4, 1e-4])],
)
def test_a_stop_while_posenet_learns_alone_or_after_it_changes_nothing(run, profile_of, tmp_path, more, rates):
    profile = profile_of(training={"beyond_paper_corridor_steps": 2} | more)
    whole = run("whole", profile=profile)
    log = pd.read_csv(tmp_path / "whole/log.csv")
    assert list(log["learning_rate"][:3]) == pytest.approx(rates)
    assert list(log["feature_spread"] > 0) == [False] * 2 + [True] * (STEPS - 2)  # a corridor has none
    for number in (1, 2):  # the second is after it: it counts from the checkpoint
        with pytest.raises(SystemExit):
            run("cut", profile=profile, kind=at_forward(number, kill_softly))
    assert last_checkpoint(tmp_path / "cut")["step"] == 3
    assert equal(run("cut", profile=profile), whole)


@pytest.mark.parametrize("corridor", [0, 2])
def test_the_running_mean_of_weights_after_a_corridor_is_kept_and_goes_on_after_a_stop(run, profile_of, corridor):
    seen, settings = [], {"beyond_paper_corridor_steps": corridor}

    class Noting(Stage):
        def forward(self, batch, *phase):
            seen.append({name: value.detach().clone() for name, value in self.state_dict().items()})
            return super().forward(batch, *phase)

    last = run("last", profile=profile_of(training=settings))
    profile = profile_of(training=settings | {"beyond_paper_average": 0.6})
    mean = run("whole", profile=profile, kind=Noting)
    slow = seen[corridor + 1]  # after the first step that counts
    for number, values in enumerate([*seen[corridor + 2 :], last], start=1):
        share = max(0.4, 9 / (10 + number))
        slow = {n: (1 - share) * slow[n] + share * v if v.is_floating_point() else v for n, v in values.items()}
    assert all(torch.allclose(mean[name], value, atol=1e-6) for name, value in slow.items()) and not equal(mean, last)
    for number in (1, 4):
        with pytest.raises(SystemExit):
            run("cut", profile=profile, kind=at_forward(number, kill_softly))
    assert equal(run("cut", profile=profile), mean)


def test_a_compiled_training_that_was_cut_off_goes_on_to_the_same_weights(run, profile_of, monkeypatch, tmp_path):
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="eager"))  # all but the code, which takes minutes
    profile, save = profile_of(training={"compile": True, "checkpoint_every": 3}), Trainer._save

    def save_and_break(trainer, step):
        save(trainer, step)
        raise ArithmeticError

    whole = run("whole", profile=profile)
    with monkeypatch.context() as context, pytest.raises(ArithmeticError):
        context.setattr(Trainer, "_save", save_and_break)
        run("cut", profile=profile)
    assert last_checkpoint(tmp_path / "cut")["step"] == 3
    assert equal(run("cut", profile=profile), whole)


@pytest.mark.parametrize(("after", "refined"), [(None, STEPS * [False]), (2, 2 * [False] + (STEPS - 2) * [True])])
def test_poses_are_refined_after_so_many_steps_also_of_a_resumed_training(run, profile_of, after, refined):
    flags, profile = [], profile_of(training={"beyond_paper_refined_after": after})

    class Noting(Stage):
        def forward(self, batch, in_a_corridor, refine):
            flags.append(refine)
            return super().forward(batch, in_a_corridor, refine)

    whole = run("whole", profile=profile, kind=Noting)
    with pytest.raises(SystemExit):
        run("cut", profile=profile, kind=at_forward(3, kill_softly))
    assert equal(run("cut", profile=profile, kind=Noting), whole) and flags == refined + refined[3:]


def test_a_killed_run_goes_on_from_its_last_checkpoint_to_the_same_weights_and_log(run, whole_and_log, tmp_path):
    whole, log = whole_and_log
    with pytest.raises(KeyboardInterrupt):
        run("cut", kind=at_forward(4, kill))
    assert last_checkpoint(tmp_path / "cut")["step"] == 2
    assert list(pd.read_csv(tmp_path / "cut/log.csv")["step"]) == [1, 2, 3]
    (tmp_path / "cut/panels").mkdir(exist_ok=True)
    (tmp_path / "cut/panels/step_0000099.png").touch()  # of a longer run before
    assert equal(run("cut"), whole)
    assert [path.name for path in (tmp_path / "cut/panels").iterdir()] == [f"step_{STEPS:07d}.png"]
    pd.testing.assert_frame_equal(log_of(tmp_path / "cut"), log)
    assert list(log["step"]) == list(range(1, STEPS + 1))
    assert load_card(tmp_path / "cut/model.safetensors")["resumed_at"] == 2


@pytest.mark.parametrize(("minutes", "step"), [(1e-9, 3), (10.0, None)])
def test_a_checkpoint_is_due_by_time_too(run, profile_of, tmp_path, minutes, step):
    with pytest.raises(KeyboardInterrupt):
        run(kind=at_forward(4, kill), profile=profile_of(training={"checkpoint_every": 1000, "checkpoint_minutes": minutes}))
    saved = last_checkpoint(tmp_path / "run")
    assert (saved and saved["step"]) == step


def test_random_draws_inside_a_network_are_the_same_after_a_stop(run, whole):
    class Dropping(Stage):
        def forward(self, batch, *phase):
            output = super().forward(batch, *phase)
            noise = torch.rand(())  # as dropout draws
            return output._replace(losses=output.losses._replace(total=output.losses.total * noise))

    dropped = run("dropping", kind=Dropping)
    with pytest.raises(SystemExit):
        run("cut", kind=at_forward(4, kill_softly, Dropping))
    assert equal(run("cut", kind=Dropping), dropped)
    assert not equal(dropped, whole)


def test_a_training_ends_in_the_precision_in_which_it_began(run, profile_of, tmp_path, monkeypatch, capsys):
    """`auto` means another one on the machine where it goes on."""
    profile = profile_of(training={"precision": "auto"}, hr_size=WIDE)
    monkeypatch.setattr("dualdepth.device.has_bf16", lambda device: False)
    whole = run("whole", profile=profile)
    with pytest.raises(SystemExit):
        run("cut", profile=profile, kind=at_forward(3, kill_softly))
    monkeypatch.setattr("dualdepth.device.has_bf16", lambda device: True)
    assert equal(run("cut", profile=profile), whole)
    assert "in float32" in capsys.readouterr().out
    assert load_card(tmp_path / "cut/model.safetensors")["precision"] == "float32"


def test_a_checkpoint_of_another_recipe_is_not_resumed(run, whole, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("cut", kind=at_forward(3, kill_softly), recipe="old", seed=5)
    weights = run("cut", recipe="new")
    assert "settings or code changed since the checkpoint of step 3; training from the start" in capsys.readouterr().out
    assert equal(weights, whole)
    assert load_card(tmp_path / "cut/model.safetensors")["resumed_at"] == 0


def test_a_log_that_cannot_be_written_is_a_warning(run, whole, monkeypatch, capsys):
    monkeypatch.setattr("dualdepth.training.log.write_text", Mock(side_effect=OSError(28, "No space left on device")))
    assert equal(run("full"), whole)
    assert "warning: the log was not written ([Errno 28] No space left on device)" in capsys.readouterr().out
