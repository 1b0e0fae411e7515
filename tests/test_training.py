"""The training loop: it learns, it repeats itself to the bit, it goes on where it was killed, and it stops in one line."""

import json
import os
import signal

import pandas as pd
import pytest
import torch
from accelerate.state import AcceleratorState
from safetensors.torch import load_file
from small_kitti import DRIVE

from dualdepth.checkpoints import checkpoint_paths, last_checkpoint, load_card
from dualdepth.config import load_profile
from dualdepth.data.bad_frames import BadFrames
from dualdepth.data.loading import TripletDataset
from dualdepth.data.triplets import drive_triplets, load_triplets, write_targets
from dualdepth.errors import InputError
from dualdepth.faults import load_failure
from dualdepth.precision import has_bf16
from dualdepth.stages import LRStage
from dualdepth.training import train
from dualdepth.training_log import read_log

BF16 = pytest.param("bf16", marks=pytest.mark.skipif(not has_bf16(torch.device("cpu")), reason="this CPU only imitates bf16"))
STEPS = 6
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
        settings = {"workers": 0, "precision": "float32", "checkpoint_every": 2, "log_every": 1} | (training or {})
        values = {
            "about": "a test",
            "data": {"source": "kitti", "train_drives": [DRIVE], "hr_size": hr_size},
            "training": {"encoder": encoder, "pretrained": False, **settings}
            | {"lr": {"epochs": 2, "batch_size": 1} | (stage or {}), "loss": loss or {}, "augmentation": augmentation or {}},
        }
        path = tmp_path / "own.yaml"
        path.write_text(json.dumps(values))  # JSON is YAML
        return load_profile(str(path))

    return make


@pytest.fixture
def triplets(kitti_root, tmp_path):
    """Three triplets of five frames."""
    path = tmp_path / "triplets.csv"
    write_targets(path, kitti_root, drive_triplets(kitti_root, [DRIVE]))
    return load_triplets(path, kitti_root)


@pytest.fixture
def run(profile_of, triplets, tmp_path):
    def call(folder="run", make_model=LRStage, profile=None, seed=0, recipe="r", given=None):
        profile = profile or profile_of()
        path = train(
            make_model, profile.training.lr, profile, given or triplets, tmp_path / folder, seed=seed, recipe=recipe, card={"is": "x"}
        )
        assert path == tmp_path / folder / "model.safetensors"
        return load_file(path)

    return call


def at_forward(number, event):
    """A stage that calls `event(output)` on its forward with this number, and gives what that returns."""

    class Stage(LRStage):
        calls = 0

        def forward(self, batch):
            output = super().forward(batch)
            Stage.calls += 1
            return (event(output) or output) if Stage.calls == number else output

    return Stage


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(v, b[k]) for k, v in a.items())


def kill_softly(_):
    os.kill(os.getpid(), signal.SIGTERM)


def kill(_):
    raise KeyboardInterrupt


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


@pytest.mark.parametrize("number", [1, 3, 4, STEPS])
def test_a_run_that_was_told_to_stop_goes_on_to_the_same_weights(run, tmp_path, number):
    whole = run("whole")
    with pytest.raises(SystemExit, match=f"stopped at step {number} of {STEPS}"):
        run("cut", make_model=at_forward(number, kill_softly))
    assert last_checkpoint(tmp_path / "cut")["step"] == number
    assert equal(run("cut"), whole)


def test_a_killed_run_goes_on_from_its_last_checkpoint_to_the_same_weights_and_log(run, tmp_path):
    whole = run("whole")
    with pytest.raises(KeyboardInterrupt):
        run("cut", make_model=at_forward(4, kill))
    assert last_checkpoint(tmp_path / "cut")["step"] == 2
    assert list(read_log(tmp_path / "cut/log.csv")["step"]) == [1, 2, 3]
    (tmp_path / "cut/panels").mkdir(exist_ok=True)
    (tmp_path / "cut/panels/step_0000099.png").touch()  # of a longer run before
    assert equal(run("cut"), whole)
    assert [path.name for path in (tmp_path / "cut/panels").iterdir()] == [f"step_{STEPS:07d}.png"]
    logs = [read_log(tmp_path / name / "log.csv").drop(columns="steps_per_second") for name in ("cut", "whole")]
    pd.testing.assert_frame_equal(*logs)
    assert list(logs[0]["step"]) == list(range(1, STEPS + 1))
    card = json.loads((tmp_path / "cut/model.json").read_text())
    assert card["resumed_at"] == 2


def test_random_draws_inside_a_network_are_the_same_after_a_stop(run):
    class Dropping(LRStage):
        def forward(self, batch):
            output = super().forward(batch)
            noise = torch.rand(())  # as dropout draws
            return output._replace(losses=output.losses._replace(total=output.losses.total * noise))

    whole = run("whole", make_model=Dropping)

    class Stopped(Dropping):
        calls = 0

        def forward(self, batch):
            Stopped.calls += 1
            if Stopped.calls == 4:
                os.kill(os.getpid(), signal.SIGTERM)
            return super().forward(batch)

    with pytest.raises(SystemExit):
        run("cut", make_model=Stopped)
    assert equal(run("cut", make_model=Dropping), whole)
    assert not equal(run("plain"), whole)


def test_a_training_ends_in_the_precision_in_which_it_began(run, profile_of, tmp_path, monkeypatch, capsys):
    """`auto` means another one on the machine where it goes on."""
    profile = profile_of(training={"precision": "auto"}, hr_size=WIDE)
    monkeypatch.setattr("dualdepth.precision.has_bf16", lambda device: False)
    whole = run("whole", profile=profile)
    with pytest.raises(SystemExit):
        run("cut", profile=profile, make_model=at_forward(3, kill_softly))
    monkeypatch.setattr("dualdepth.precision.has_bf16", lambda device: True)
    assert equal(run("cut", profile=profile), whole)
    assert "in float32" in capsys.readouterr().out
    assert load_card(tmp_path / "cut/model.safetensors")["precision"] == "float32"


def test_a_checkpoint_of_another_recipe_is_not_resumed(run, tmp_path, capsys):
    with pytest.raises(SystemExit):
        run("cut", make_model=at_forward(3, kill_softly), recipe="old", seed=5)
    weights = run("cut", recipe="new")
    assert "settings or code changed since the checkpoint of step 3; training from the start" in capsys.readouterr().out
    assert equal(weights, run("whole"))
    assert json.loads((tmp_path / "cut/model.json").read_text())["resumed_at"] == 0


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


@pytest.mark.parametrize("number", [1, 4])
def test_a_loss_that_is_not_finite_stops_with_the_names_of_the_frames(run, number, tmp_path):
    def break_loss(output):
        return output._replace(losses=output.losses._replace(total=output.losses.total * torch.nan))

    with pytest.raises(InputError, match=rf"run: loss is nan at step {number}, frames {DRIVE}/image_02/000000000[123]") as error:
        run(make_model=at_forward(number, break_loss))
    assert "\n" not in str(error.value)
    assert str(error.value).endswith(f"dualdepth replay {tmp_path / 'run/failure.pt'}")
    assert load_failure(tmp_path / "run/failure.pt")["step"] == number
    assert not (tmp_path / "run/model.safetensors").exists()


def test_a_pose_that_is_not_finite_stops_though_the_loss_is_blind_to_it(run):
    def break_pose(output):
        return output._replace(poses=output.poses * torch.nan)

    with pytest.raises(InputError, match="pose is nan at step 2"):
        run(make_model=at_forward(2, break_pose))


def test_weights_that_are_not_finite_do_not_replace_the_last_good_checkpoint(run, tmp_path):
    """A finite loss can have an infinite gradient."""

    def break_gradient(output):
        total = output.losses.total
        total.register_hook(lambda gradient: gradient * torch.nan)
        return output._replace(losses=output.losses._replace(total=total))

    with pytest.raises(InputError, match="gradient is nan at step 3"):
        run(make_model=at_forward(3, break_gradient))
    saved = last_checkpoint(tmp_path / "run")
    assert all(v.isfinite().all() for v in saved["model"].values())
    assert saved["step"] == 2


@pytest.mark.parametrize("workers", [0, 1])
def test_a_bad_image_stops_the_training_in_one_line_that_names_it(run, profile_of, kitti_root, workers, tmp_path):
    path = kitti_root / DRIVE / "image_02/data/0000000004.png"
    path.write_bytes(path.read_bytes()[:500])
    with pytest.raises(InputError, match=r"^\S*0000000004\.png: truncated \(500 bytes\); copy or download it again$"):
        run(profile=profile_of(training={"workers": workers}))
    assert not (tmp_path / "run/model.safetensors").exists()


@pytest.mark.parametrize("workers", [0, 1])
def test_a_bad_image_can_be_skipped_and_is_listed_on_the_card(run, profile_of, kitti_root, workers, tmp_path):
    path = kitti_root / DRIVE / "image_02/data/0000000004.png"
    path.write_bytes(path.read_bytes()[:500])
    skip = {"on_bad_frame": "skip", "workers": workers}
    weights = run(profile=profile_of(training=skip))
    skipped = load_card(tmp_path / "run/model.safetensors")["skipped"]
    assert list(skipped) == [f"{DRIVE}/image_02/0000000003"]
    assert "0000000004.png: truncated" in next(iter(skipped.values()))
    # a training that is stopped and goes on skips the same
    with pytest.raises(SystemExit):
        run("cut", make_model=at_forward(3, kill_softly), profile=profile_of(training=skip))
    assert equal(run("cut", profile=profile_of(training=skip)), weights)
    assert load_card(tmp_path / "cut/model.safetensors")["skipped"] == skipped
    with pytest.raises(InputError, match=r"0000000004\.png: truncated.*0 triplets were skipped before it, max_bad_frames is 0"):
        run("strict", profile=profile_of(training=skip | {"max_bad_frames": 0}))


def test_a_skipped_triplet_gives_its_place_to_the_next(profile_of, triplets, kitti_root, tmp_path):
    path = kitti_root / DRIVE / "image_02/data/0000000004.png"
    path.unlink()
    bad_frames = BadFrames(tmp_path / "bad.jsonl", 5)
    dataset = TripletDataset(triplets, (192, 192), profile_of().training.augmentation, 0, bad_frames)
    taken, own = dataset[(3, 2)], dataset[(3, 0)]
    assert taken["name"] == own["name"] == triplets[0].name
    assert torch.equal(taken["images"], own["images"])
    assert list(bad_frames.reasons()) == [triplets[2].name]
    for image in path.parent.iterdir():
        image.unlink()
    with pytest.raises(InputError, match="none of 3 triplets can be read"):
        dataset[(0, 0)]


def test_a_checkpoint_or_log_that_cannot_be_written_is_a_warning(run, tmp_path, monkeypatch, capsys):
    whole = run("whole")

    def refuse(path, text):
        raise OSError(28, "No space left on device")

    def full(state, path):
        raise RuntimeError("PytorchStreamWriter failed writing file data/3")

    monkeypatch.setattr("dualdepth.training_log.write_text", refuse)
    monkeypatch.setattr(torch, "save", full)
    assert equal(run("full"), whole)
    said = capsys.readouterr().out
    assert "warning: checkpoint of step 2 was not written" in said and "there is none yet" in said
    assert "warning: the log was not written ([Errno 28] No space left on device)" in said


def test_weights_that_cannot_be_written_are_an_error_and_the_checkpoint_stays(run, tmp_path, monkeypatch):
    whole = run("whole")

    def full(tensors, path):
        raise OSError(28, "No space left on device")

    with monkeypatch.context() as patched:
        patched.setattr("dualdepth.checkpoints.save_file", full)
        with pytest.raises(InputError, match=r"full/model\.safetensors: could not be written \(.*No space left"):
            run("full")
    assert last_checkpoint(tmp_path / "full")["step"] == STEPS
    assert not list((tmp_path / "full").glob(".*part*"))
    assert equal(run("full"), whole)


def test_leftovers_of_a_killed_writer_are_removed(run, profile_of, tmp_path):
    leftover = tmp_path / "run/.checkpoint_00000004.0123abcd.part.pt"
    leftover.parent.mkdir()
    leftover.write_bytes(b"half")
    run(profile=profile_of(stage={"max_steps": 1}))
    assert not leftover.exists()


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

    class Watched(LRStage):
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
