"""No drive is scored that was trained on, unless asked for, and then the result says so."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from dualdepth.cli import main
from dualdepth.data.depth_maps import save_ground_truth
from dualdepth.data.odometry import write_trajectory
from dualdepth.errors import InputError
from dualdepth.evaluation.leaks import check_leak
from dualdepth.training.weights import save_weights

RAW_33 = "2011_09_30/2011_09_30_drive_0033_sync"
CARD = {"drives": ["2011_09_26/2011_09_26_drive_0001_sync", RAW_33]}


def test_a_leak_is_refused_by_name_with_the_mend_or_marks_the_result_and_other_drives_pass():
    with pytest.raises(InputError, match=r"model\.safetensors: was trained on .*drive_0033_sync.*--allow-leak"):
        check_leak(CARD, [RAW_33], allow=False, weights="model.safetensors")
    assert check_leak(CARD, [RAW_33, "other"], allow=True) == f"LEAK: trained on {RAW_33}"
    assert check_leak(CARD, ["2011_09_26/2011_09_26_drive_0002_sync"], allow=False) == check_leak(CARD, [], allow=False) == ""
    with pytest.raises(InputError, match="does not say which drives"):
        check_leak({}, [RAW_33], allow=False)


@pytest.fixture
def scored(tmp_path, monkeypatch):
    """Predictions, ground truth and a list of two frames of drive 0001, and a trajectory, in the working directory."""
    monkeypatch.chdir(tmp_path)
    np.save("P.npy", np.full((2, 4, 6), 5.0, np.float32))
    save_ground_truth("G.npz", [np.full((40, 60), 5.0, np.float32)] * 2)
    (tmp_path / "list.txt").write_text("".join(f"2011_09_26/2011_09_26_drive_0001_sync {i:010d} l\n" for i in range(2)))
    poses = np.tile(np.eye(4), (5, 1, 1))
    poses[:, 2, 3] = np.arange(5)
    write_trajectory("poses.txt", poses)


def weights(drives):
    save_weights("W.safetensors", torch.nn.Linear(1, 1), {"drives": drives})


DEPTH = ["evaluate", "depth", "--pred", "P.npy", "--gt", "G.npz", "--json", "-", "--weights", "W.safetensors", "--list", "list.txt"]
POSES = ["evaluate", "odometry", "--pred", "poses.txt", "--gt", "poses.txt", "--json", "-"]
POSES += ["--weights", "W.safetensors", "--sequence", "09"]


@pytest.mark.parametrize("command", [DEPTH, POSES])
def test_the_commands_refuse_a_leak_unless_allowed(scored, capsys, refused, command):
    weights(CARD["drives"])
    assert "W.safetensors: was trained on" in refused(main, [w.replace("P.npy", "gone.npy") for w in command])  # before they are read
    assert main([*command, "--allow-leak"]) == 0
    assert json.loads(capsys.readouterr().out)["leak"].startswith("LEAK: trained on 2011_")
    weights(["2011_09_26/2011_09_26_drive_0009_sync"])
    assert main(command) == 0
    assert "leak" not in json.loads(capsys.readouterr().out)


@pytest.mark.parametrize("without", [1, 2])
def test_of_a_list_those_frames_are_guarded_that_have_ground_truth(scored, refused, without):
    weights(["2011_09_26/2011_09_26_drive_0001_sync"])
    Path("list.txt").write_text("".join(f"2011_09_26/2011_09_26_drive_{drive:04d}_sync 0000000000 l\n" for drive in (2, 1, 3)))
    save_ground_truth("G.npz", [np.full((40, 60), 5.0, np.float32)] * 2, [f"{i:06d}" for i in range(3) if i != without], 3)
    assert main(DEPTH) == 0 if without == 1 else "was trained on" in refused(main, DEPTH)


@pytest.mark.parametrize(
    ("command", "said"),
    [
        (POSES, "was trained on odometry/09"),
        ([*POSES[:-1], "9"], "sequence '9': give one of 00, 01"),
        (DEPTH, "list.txt: lists 1 frames but G.npz holds 2"),
        (DEPTH[:-2], "--weights and --list guard together"),
        (DEPTH[:-4] + DEPTH[-2:], "--weights and --list guard together"),
    ],
    ids=["a sequence of the world", "a bad name", "a list of other frames", "no list", "no weights"],
)
def test_half_a_guard_guards_nothing_and_sequences_of_the_world_are_guarded_too(scored, refused, command, said):
    weights(["odometry/09"])
    Path("list.txt").write_text("2011_09_26/2011_09_26_drive_0001_sync 0000000000 l\n")
    assert said in refused(main, command)
