"""Checkpoints: what is written reads back, damage is told and the one before used, and nothing else is taken for one."""

import pickle

import pytest
import torch
from small_nets import Trap, equal, trained_net

from dualdepth.errors import InputError
from dualdepth.training.checkpoints import checkpoint_paths, last_checkpoint, load_checkpoint, save_checkpoint


def save(folder, step, net, optimizer, keep=2, **facts):
    state = {"recipe": "abc", "parts": 1, "precision": "float32", "step": step} | facts
    return save_checkpoint(folder, state | {"model": net.state_dict(), "optimizer": optimizer.state_dict()}, keep)


def test_a_checkpoint_makes_the_round_trip(tmp_path):
    net, optimizer = trained_net()
    path = save(tmp_path, 7, net, optimizer, parts=2, precision="bf16")
    state = load_checkpoint(path)
    assert [state[key] for key in ("recipe", "parts", "precision", "step")] == ["abc", 2, "bf16", 7]
    assert equal(state["model"], net.state_dict())
    moments = optimizer.state_dict()["state"][0]
    assert torch.equal(state["optimizer"]["state"][0]["exp_avg_sq"], moments["exp_avg_sq"])
    assert list(tmp_path.iterdir()) == [path]


def test_the_newest_are_kept(tmp_path):
    for step in (9, 10, 11, 100):
        save(tmp_path, step, *trained_net(), keep=3)
    assert [path.name for path in checkpoint_paths(tmp_path)] == [f"checkpoint_{step:08d}.pt" for step in (100, 11, 10)]
    assert last_checkpoint(tmp_path)["step"] == 100


@pytest.mark.parametrize("share", [0, 0.5, 0.999])
def test_a_damaged_checkpoint_is_told_and_the_one_before_it_is_used(tmp_path, share):
    paths = [save(tmp_path, step, *trained_net()) for step in (7, 8)]
    paths[1].write_bytes(paths[1].read_bytes()[: int(share * paths[1].stat().st_size)])
    told = []
    assert last_checkpoint(tmp_path, told.append)["step"] == 7
    assert len(told) == 1 and "checkpoint_00000008.pt" in told[0]
    paths[0].write_bytes(b"")
    with pytest.raises(InputError, match=r"checkpoint_00000007\.pt: .*not a checkpoint"):
        last_checkpoint(tmp_path, told.append)


def test_one_changed_byte_of_a_tensor_is_noticed(tmp_path):
    net, optimizer = trained_net()
    path = save(tmp_path, 7, net, optimizer)
    content = bytearray(path.read_bytes())
    place = content.find(next(net.parameters()).detach().numpy().tobytes())
    assert place > 0
    content[place + 1] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a checkpoint of this project"):
        load_checkpoint(path)


FOREIGN = {
    "pickle": lambda path, trap: path.write_bytes(pickle.dumps(trap, protocol=2)),
    "trap in a torch file": lambda path, trap: torch.save({"recipe": trap, "parts": 1, "step": 1, "model": {}, "optimizer": {}}, path),
    "other keys": lambda path, trap: torch.save({"epoch": 3}, path),
    "a number": lambda path, trap: torch.save(3, path),
    **{str(content): lambda path, trap, c=content: path.write_bytes(c) for content in (b"x", b"PK\x03\x04 not a zip", b"\x80\x02.")},
}


@pytest.mark.parametrize("kind", FOREIGN)
def test_what_is_no_checkpoint_is_refused_in_one_line_and_its_code_is_not_run(tmp_path, kind):
    path = tmp_path / "checkpoint.pt"
    FOREIGN[kind](path, Trap(tmp_path / "mark"))
    with pytest.raises(InputError, match=r"checkpoint\.pt: .*not a checkpoint of this project") as error:
        load_checkpoint(path)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "mark").exists()
