"""A batch that was not finite is kept, refused if it is foreign, and computed again to the same numbers."""

import json
import pickle

import pytest
import torch
from accelerate.state import AcceleratorState
from small_kitti import DRIVE
from small_stages import backbones, run_in, trained  # noqa: F401

from dualdepth.cli import main
from dualdepth.errors import InputError
from dualdepth.training.loop import load_failure, replay, write_failure
from dualdepth.training.stages import Stage


@pytest.fixture
def stage(trained):  # noqa: F811
    return Stage(trained.profile)


def batch_of(profile, value=None):
    height, width = profile.data.hr_size
    images = torch.randint(0, 255, (2, 3, 3, height, width), generator=torch.Generator().manual_seed(0), dtype=torch.uint8)
    matrix = torch.tensor([[200.0, 0, width / 2], [0, 200.0, height / 2], [0, 0, 1]]).expand(2, 3, 3).clone()
    if value is not None:
        matrix[1, 0, 0] = value
    return {"images": images, "intrinsics": matrix}


def test_a_kept_batch_is_computed_again_to_the_same_loss(stage, trained, tmp_path):  # noqa: F811
    batch = batch_of(trained.profile)
    path = write_failure(tmp_path / "failure.pt", "gradient", 7, ["a", "b"], stage.train(), batch, "float32")
    expected = stage(batch).losses.total.item()
    lines = replay(load_failure(path), Stage(trained.profile))
    assert lines[:3] == ["step 7: gradient was not finite", "frame a", "frame b"]
    assert f"float32: total {expected:.6g}" in "\n".join(lines)
    assert "weights: finite" in lines and "float32: gradients: finite" in lines


def test_replay_names_what_is_not_finite(stage, trained, tmp_path):  # noqa: F811
    with torch.no_grad():
        stage.pose_net.layers[-1].bias[0] = torch.nan
    path = write_failure(tmp_path / "failure.pt", "loss", 1, ["a", "b"], stage, batch_of(trained.profile, torch.inf), "bf16")
    text = "\n".join(replay(load_failure(path), Stage(trained.profile)))
    assert "weights: NOT finite in pose_net.layers" in text
    assert "intrinsics: NOT finite" in text
    assert "bf16: total" in text and "float32: total" in text


def test_the_command_finds_the_training_by_the_files_place(trained, monkeypatch, tmp_path, capsys):  # noqa: F811
    stage = Stage(trained.profile)
    folder = trained.training("lr", 0)
    path = write_failure(folder / "failure.pt", "loss", 3, [f"{DRIVE} 1"], stage, batch_of(trained.profile), "float32")
    monkeypatch.chdir(trained.root)
    try:
        assert main(["replay", str(path), "--profile", "own.yaml"]) == 0
    finally:
        path.unlink()
        AcceleratorState._reset_state(reset_partial_state=True)
    assert "step 3: loss was not finite" in capsys.readouterr().out
    for wrong, said in (
        (folder / "none.pt", "is not there"),
        (trained.root / "own.yaml", "not a failure kept by a training of this project"),
    ):
        with pytest.raises(SystemExit) as stop:
            main(["replay", str(wrong)])
        assert stop.value.code == 2
        message = capsys.readouterr().err
        assert said in message and str(wrong) in message and message.count("\n") == 1


class Trap:
    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return open, (self.mark, "w")


def test_code_in_a_foreign_file_is_not_run(tmp_path):
    (tmp_path / "failure.pt").write_bytes(pickle.dumps(Trap(tmp_path / "mark")))
    torch.save({"what": Trap(tmp_path / "mark")}, tmp_path / "other.pt")
    (tmp_path / "text.pt").write_text(json.dumps({"what": 1}))
    for name in ("failure.pt", "other.pt", "text.pt"):
        with pytest.raises(InputError, match=name):
            load_failure(tmp_path / name)
    assert not (tmp_path / "mark").exists()
