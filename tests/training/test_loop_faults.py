"""Numbers that are not finite and frames that cannot be read: the training says where, in one line, and keeps what was good."""

import multiprocessing

import pytest
import torch
from small_kitti import DRIVE
from small_training import at_forward

from dualdepth.errors import InputError
from dualdepth.training.checkpoints import last_checkpoint


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
