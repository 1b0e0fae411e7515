"""Numbers that are not finite and frames that cannot be read: the training says where, and keeps what was good."""

import pytest
import torch
from dualdepth.data.bad_frames import BadFrames
from small_kitti import DRIVE
from small_training import at_forward, equal, kill_softly, profile_of, quiet_torch, run, triplets  # noqa: F401

from dualdepth.data.loading import TripletDataset
from dualdepth.errors import InputError
from dualdepth.training.checkpoints import last_checkpoint
from dualdepth.training.loop import load_failure
from dualdepth.training.weights import load_card

# ruff: noqa: F811


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
