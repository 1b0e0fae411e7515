"""Trainings by name: what each starts from and asks for, what its card says, when it is done or stale, and how it stops."""

import json
import os
import shutil
from unittest.mock import Mock

import pandas as pd
import pytest
import torch
from small_kitti import DRIVE, write_sequence
from small_nets import equal
from small_stages import OTHER, STEPS, change_card, part

from dualdepth.data.odometry import odometry_triplets
from dualdepth.data.triplets import write_triplets
from dualdepth.device import device_name
from dualdepth.errors import InputError
from dualdepth.files import file_digest, locked
from dualdepth.model import load, load_pose_net
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.depth_nets import DualNet
from dualdepth.networks.pose_net import EncoderPoseNet
from dualdepth.run import Sources
from dualdepth.training import variants
from dualdepth.training.loop import Trainer
from dualdepth.training.stages import Stage
from dualdepth.training.variants import make_stage, start_weights, train_variant
from dualdepth.training.weights import load_card

pytestmark = pytest.mark.slow


def test_dual_holds_stage_1s_lr_net_to_the_bit_and_a_posenet_that_went_on(trained):
    lr, dual = trained.weights("lr", 0), trained.weights("dual", 0)
    assert equal(part(dual, "depth_net.lr_net."), part(lr, "depth_net."))
    before, after = (part(weights, "pose_net.") for weights in (lr, dual))
    assert before.keys() == after.keys() and not any(torch.equal(value, after[name]) for name, value in before.items())
    assert part(dual, "depth_net.hr_net.")
    assert part(dual, "depth_net.attention.")


@pytest.mark.parametrize("name", ["dual", "dual_no_sa", "hr_only"])
def test_stage_2_begins_with_stage_1s_posenet_and_a_dual_network_with_its_lr_net(trained, name):
    stage = make_stage(trained.profile, name, start_weights(trained, name, 0))
    assert equal(stage.pose_net.state_dict(), part(trained.weights("lr", 0), "pose_net."))
    if name == "hr_only":
        assert not hasattr(stage.depth_net, "lr_net")
    else:
        assert equal(stage.depth_net.lr_net.state_dict(), part(trained.weights("lr", 0), "depth_net."))
        assert not any(p.requires_grad for p in stage.depth_net.lr_net.parameters())


def test_a_single_network_begins_with_nothing_and_sees_images_at_full_size(trained):
    assert start_weights(trained, "one_network", 0) is None
    assert not make_stage(trained.profile, "one_network").low


@pytest.mark.parametrize(("name", "pretrained"), [("lr", True), ("dual", False), ("hr_only", False), ("one_network", True)])
def test_imagenets_weights_are_for_networks_that_start_from_nothing(trained, monkeypatch, name, pretrained):
    """LR-Net's encoder is stage 1's, so a hub that cannot be reached must not stop stage 2."""
    asked, build = [], Architecture.build
    monkeypatch.setattr(Architecture, "build", lambda self, pretrained=False: asked.append(pretrained) or build(self))
    profile = trained.profile.model_copy(update={"training": trained.profile.training.model_copy(update={"pretrained": True})})
    make_stage(profile, name, start_weights(trained, name, 0))
    assert asked == [pretrained]


def test_a_posenet_with_an_encoder_is_trained_and_read_back_and_another_is_no_start_of_stage_2(after_stage_1):
    with_encoder = {"training.beyond_paper_pose_encoder": "efficientnet_lite0"}
    run = after_stage_1(train={"lr": None, "dual": with_encoder | {"training.hr.max_steps": 1}})
    with pytest.raises(InputError, match="pose_encoder None instead of 'efficientnet_lite0'"):
        train_variant(run, "dual", 0)
    frozen = with_encoder | {"training.hr.max_steps": 1, "training.hr.beyond_paper_frozen_pose": True}
    dual = with_encoder | {"training.hr.max_steps": 1}
    run = after_stage_1("both", train={"lr": with_encoder, "dual": dual, "dual_no_sa": frozen})
    first = part(train_variant(run, "lr", 0), "pose_net.")
    assert equal(make_stage(run.profile, "dual", run.weights("lr", 0)).pose_net.state_dict(), first)
    net, size = load_pose_net(train_variant(run, "dual", 0))
    assert size == (192, 192) and equal(net.state_dict(), part(run.weights("dual", 0), "pose_net.")) and not equal(net.state_dict(), first)
    assert equal(part(train_variant(run, "dual_no_sa", 0), "pose_net."), first)  # batch norm's statistics among them


@pytest.mark.parametrize(("place", "given"), [(True, True), (False, False), ("some/folder", True)])
def test_a_posenets_encoder_begins_with_imagenets_weights_in_stage_1_alone(trained, monkeypatch, place, given):
    """A place of weights that the profile names is of the depth network's encoder, which is another here."""
    asked, pose_net = [], EncoderPoseNet("efficientnet_lite0")
    monkeypatch.setattr(variants, "make_pose_net", lambda encoder, pretrained: asked.append((encoder, pretrained)) or pose_net)
    monkeypatch.setattr(Architecture, "build", lambda self, pretrained=False, build=Architecture.build: build(self))
    monkeypatch.setattr(variants, "load_weights", lambda *_, **__: None)
    more = {"pretrained": place, "beyond_paper_pose_encoder": "efficientnet_lite0"}
    profile = trained.profile.model_copy(update={"training": trained.profile.training.model_copy(update=more)})
    make_stage(profile, "lr")
    make_stage(profile, "dual", trained.weights("lr", 0))
    assert asked == [("efficientnet_lite0", given), ("efficientnet_lite0", False)]


def test_the_card_says_which_network_it_is_what_it_saw_and_what_it_started_from(trained, encoder):
    lr, dual = (load_card(trained.weights(name, 0)) for name in ("lr", "dual"))
    expected = {
        "variant": "dual",
        "network": "dual",
        "encoder": encoder,
        "link": "attention",
        "similarity": "dot",
        "normalise": "none",
        "hr_size": [192, 192],
        "pretrained": False,
        "drives": [DRIVE, OTHER],  # stage 1's too
        "starts_from": {"variant": "lr", "seed": 0, "steps": 2, "sha256": file_digest(trained.weights("lr", 0))},
        "frozen_pose": False,
        "seed": 0,
        "recipe": trained.recipe("dual", 0),
        "steps": STEPS,
        "sha256": file_digest(trained.weights("dual", 0)),
    }
    assert {name: dual[name] for name in expected} == expected
    assert dual["about"].endswith(", trained on 3 triplets: a test")
    assert (lr["variant"], lr["network"], lr["drives"], lr["starts_from"], lr["steps"]) == ("lr", "lr", [DRIVE], None, 2)
    inputs = {"work/own/prepared/triplets.csv", "work/own/runs/lr/seed0/model.safetensors"}
    assert dual["stamp"]["inputs_sha256"] == {name: file_digest(trained.root / name) for name in inputs}


@pytest.mark.parametrize("said", [True, False])
@pytest.mark.parametrize("name", ["dual", "dual_no_sa", "hr_only"])
def test_whether_imagenets_weights_are_in_it_stands_in_stage_1s_card(after_stage_1, monkeypatch, name, said):
    """The profile says that there are none, and HR-Net by itself never has any."""
    begun = Mock(side_effect=KeyboardInterrupt)
    monkeypatch.setattr(Trainer, "run", begun)
    run = after_stage_1()
    change_card(run, pretrained=said)
    with pytest.raises(KeyboardInterrupt):
        train_variant(run, name, 0)
    assert begun.call_args.args[0]["pretrained"] == (said and name != "hr_only")


@pytest.mark.parametrize(("name", "network"), [("lr", "lr"), ("dual", "dual"), ("hr_only", "hr"), ("one_network", "single")])
def test_each_kind_of_network_is_trained_as_said_before_and_read_back(trained, after_stage_1, name, network, capsys):
    run = trained if name in ("lr", "dual") else after_stage_1()
    weights = run.weights(name, 0)
    if run is not trained:
        train_variant(run, name, 0)
        assert load_card(weights)["steps"] == 1
        begins = {"hr_only": "HR-Net by itself, after stage 1 (lr)"}
        begins["one_network"] = "one, starting from random weights"
        plan = f"{name}, seed 0: {begins[name]}\n1 steps in batches of 1, of 3 triplets, on {device_name()} in float32; "
        assert capsys.readouterr().out.startswith(plan)
        drives = {"hr_only": [DRIVE, OTHER], "one_network": [OTHER]}[name]
        assert load_card(weights)["drives"] == drives
        assert (load_card(weights)["starts_from"] is None) == (name == "one_network")
    model = load(weights)
    assert model.architecture.network == network
    assert model.size == (192, 192)
    assert equal(model.depth_net.cpu().state_dict(), part(weights, "depth_net."))


def test_what_is_done_is_not_trained_again_but_marked_and_what_a_kill_left_beside_it_is_removed(trained, capsys, monkeypatch):
    monkeypatch.setattr(Stage, "forward", lambda *_: pytest.fail("it trains"))
    weights = trained.weights("dual", 0)
    marker = weights.with_name("trained.json")
    before = weights.stat().st_mtime_ns
    for _ in range(2):
        assert json.loads(marker.read_text()) == {"weights_sha256": file_digest(weights)}
        marker.unlink()
        left = [weights.with_name(name) for name in (".trained.0123abcd.part.json", "checkpoint_00000003.pt")]
        for path in left:
            path.touch()
        assert train_variant(trained, "dual", 0) == weights
        assert not any(path.exists() for path in left)
    assert capsys.readouterr().out == 2 * "already trained: 3 steps, seed 0\n"
    assert weights.stat().st_mtime_ns == before


def test_what_is_being_trained_is_not_trained_a_second_time_and_whose_it_is_is_said(trained, monkeypatch):
    monkeypatch.setattr(variants, "PATIENCE", 0.1)
    with locked(trained.training("dual", 0) / "lock"):
        with pytest.raises(InputError, match=rf"dual/seed0/lock: held by process {os.getpid()} on \S+; wait for it or stop it"):
            train_variant(trained, "dual", 0)
        train_variant(trained, "lr", 0)  # another variant is another training
        waited = []
        monkeypatch.setattr("dualdepth.training.variants.wait_for_everyone", lambda: waited.append(True))
        monkeypatch.setenv("WORLD_SIZE", "2")
        monkeypatch.setenv("RANK", "1")
        train_variant(trained, "dual", 0)  # the second of two processes does not ask for what the first one holds, but waits for it
        assert waited


def test_another_stage_1_makes_stage_2_stale(trained, after_stage_1):
    first = after_stage_1("first", lr={"batch_size": 1, "max_steps": 1})
    shutil.copytree(trained.training("dual", 0), first.training("dual", 0))
    assert first.recipe("dual", 0) == trained.recipe("dual", 0)
    train_variant(first, "lr", 0)
    assert file_digest(first.weights("lr", 0)) != file_digest(trained.weights("lr", 0))
    assert first.recipe("dual", 0) != trained.recipe("dual", 0)
    before = first.weights("dual", 0).with_name("trained.json").read_text()
    train_variant(first, "dual", 0)
    card = load_card(first.weights("dual", 0))
    assert card["recipe"] == first.recipe("dual", 0)
    assert card["starts_from"]["sha256"] == file_digest(first.weights("lr", 0))
    assert card["drives"] == [OTHER]
    assert equal(part(first.weights("dual", 0), "depth_net.lr_net."), part(first.weights("lr", 0), "depth_net."))
    assert first.weights("dual", 0).with_name("trained.json").read_text() != before


def test_odometry_is_trained_on_its_own_triplets_and_names_the_raw_drives(trained, run_in, tmp_path):
    run = run_in(tmp_path, train={"lr": None, "odometry_lr": None, "odometry_dual": None})
    shutil.copytree(trained.prepared, run.prepared)
    write_sequence(tmp_path / "odometry", "02", range(4))
    sources = Sources.load(trained)._replace(odometry_root=tmp_path / "odometry")
    sources.save(run)
    with pytest.raises(InputError, match=r"odometry\.csv is missing: run notebook 02"):
        train_variant(run, "odometry_lr", 0)
    write_triplets(run.index("odometry_lr"), sources.odometry_root, odometry_triplets(sources.odometry_root, ["02"]))
    for name in ("odometry_lr", "odometry_dual"):
        card = load_card(train_variant(run, name, 0))
        assert card["drives"] == ["2011_10_03/2011_10_03_drive_0034_sync"] and "on 2 triplets" in card["about"]
    sources._replace(odometry_root=None).save(run)
    with pytest.raises(InputError, match="odometry_lr needs ODOMETRY_ROOT"):
        train_variant(run, "odometry_lr", 0)


def test_a_residual_dual_network_gets_its_starting_scale_once_and_is_read_back(after_stage_1, monkeypatch):
    begun, begin = [], DualNet.begin
    monkeypatch.setattr(DualNet, "begin", lambda self, image: begun.append(tuple(image.shape)) or begin(self, image))
    changes = {
        "training.beyond_paper_residual": True,
        "training.beyond_paper_residual_floor": -8.5,
        "training.beyond_paper_residual_anchor": 0.125,
        "training.beyond_paper_refined_after": 3,
        "training.hr.max_steps": 1,
        "training.beyond_paper_corridor_steps": 9,
    }  # of a new PoseNet alone
    late = {"training.beyond_paper_refined_after": 3, "training.hr.max_steps": 1}
    others = {"dual_no_sa": late, "hr_only": late, "resnet18": {"training.beyond_paper_corridor_steps": 9}}
    run = after_stage_1(train={"lr": None, "dual": changes} | others)
    train_variant(run, "dual", 0)
    assert make_stage(run.profile, "resnet18").corridor_steps == 9  # whose PoseNet is new
    assert begun == [(1, 3, 192, 192)]
    assert pd.read_csv(run.training("dual", 0) / "log.csv")["feature_spread"].min() > 0
    model = load(run.weights("dual", 0))
    stage, card = make_stage(run.profile, "dual", run.weights("lr", 0)), load_card(run.weights("dual", 0))
    assert not any(parameter.any() for head in stage.depth_net.hr_net.decoder.heads for parameter in head.parameters())
    assert model.architecture.residual and model.depth_net.floor == -8.5 and card["residual"] is card["anchored"] is card["refined"] is True
    assert stage.anchor == 0.125 and not load_card(run.weights("lr", 0))["anchored"]
    for name, at_once in (("dual_no_sa", True), ("hr_only", False)):  # LR-Net's depth is there from the first step, HR-Net's is not
        assert load_card(train_variant(run, name, 0))["refined"] == at_once


WEIGHTS, CARD = r"/runs/lr/seed0/model\.safetensors", r"/runs/lr/seed0/model\.json"
SPOILT = {
    "no weights": (
        lambda run: run.weights("lr", 0).unlink(),
        rf"^work/own{WEIGHTS} is missing: run notebook 03_train_lr, variant lr, seed 0",
    ),
    "no card": (
        lambda run: run.weights("lr", 0).with_suffix(".json").unlink(),
        f"{CARD}: no such file; keep the weights' card beside them",
    ),
    "another network": (lambda run: change_card(run, network="dual"), f"{WEIGHTS}: its card has network 'dual' .*; train lr again"),
    "another backbone": (lambda run: change_card(run, encoder="x"), f"{WEIGHTS}: its card has encoder 'x' instead of .*; train lr again"),
    "another size": (lambda run: change_card(run, hr_size=[192, 288]), rf"{WEIGHTS}: its card has hr_size \[192, 288\] instead of"),
    "an incomplete card": (lambda run: change_card(run, "drives"), f"{WEIGHTS}: its card has no drives; train lr again"),
    "a foreign card": (lambda run: run.weights("lr", 0).with_suffix(".json").write_text('{"license": "MIT"}'), f"{WEIGHTS}: .*; .+$"),
    "no triplets": (lambda run: run.index("lr").unlink(), r"^work/own/prepared/triplets\.csv is missing: run notebook 02_prepare_data"),
    "no sources": (lambda run: run.sources.unlink(), r"^work/own/sources\.json is missing: run notebook 01_download_data"),
}


@pytest.mark.parametrize("kind", SPOILT)
def test_what_stage_2_needs_is_asked_for_in_one_line_that_names_it_and_the_mend(after_stage_1, kind):
    spoil, said = SPOILT[kind]
    run = after_stage_1()
    spoil(run)
    with pytest.raises(InputError, match=said) as error:
        train_variant(run, "dual", 0)
    assert "\n" not in str(error.value)
    assert not run.weights("dual", 0).exists()
    assert not run.weights("dual", 0).with_name("trained.json").exists()


def test_stage_1_of_another_seed_does_not_do(after_stage_1):
    with pytest.raises(InputError, match=r"^work/own/runs/lr/seed1/model\.safetensors is missing: .* variant lr, seed 1, "):
        train_variant(after_stage_1(), "dual", 1)
