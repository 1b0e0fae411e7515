"""Released weights and checkpoints: what is written reads back, and nothing else is taken for it."""

import hashlib
import json
import pickle

import pytest
import torch
from torch import nn

from dualdepth.errors import InputError
from dualdepth.training import checkpoints
from dualdepth.training.checkpoints import Checkpointer, checkpoint_paths, last_checkpoint, load_checkpoint, save_checkpoint
from dualdepth.training.weights import finished_card, load_card, load_weights, save_weights


class Net(nn.Module):
    def __init__(self, width=3):
        super().__init__()
        self.depth_net = nn.Sequential(nn.Conv2d(1, width, 3), nn.BatchNorm2d(width))
        self.pose_net = nn.Linear(2, 2)


class Trap:
    """A pickle that leaves a mark when its code is run."""

    def __init__(self, mark):
        self.mark = str(mark)

    def __reduce__(self):
        return open, (self.mark, "w")


def equal(a, b):
    return a.keys() == b.keys() and all(torch.equal(v, b[k]) for k, v in a.items())


def trained_net():
    net = Net()
    optimizer = torch.optim.Adam(net.parameters())
    net.depth_net(torch.rand(2, 1, 5, 5)).sum().backward()
    optimizer.step()
    return net, optimizer


def test_weights_and_card_make_the_round_trip(tmp_path):
    net, _ = trained_net()
    path = tmp_path / "model.safetensors"
    save_weights(path, net, {"profile": "tiny", "seed": 3})
    other = Net()
    card = load_weights(path, other)
    assert equal(other.state_dict(), net.state_dict())
    assert (card["profile"], card["seed"]) == ("tiny", 3)
    assert card["sha256"] == hashlib.sha256(path.read_bytes()).hexdigest()
    assert sorted(p.name for p in tmp_path.iterdir()) == ["model.json", "model.safetensors"]


def test_a_part_of_the_weights_is_loaded_by_its_prefix(tmp_path):
    net, _ = trained_net()
    save_weights(tmp_path / "model.safetensors", net, {})
    depth_net = Net().depth_net
    load_weights(tmp_path / "model.safetensors", depth_net, prefix="depth_net.")
    assert equal(depth_net.state_dict(), net.depth_net.state_dict())


def test_changed_weights_are_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    save_weights(path, Net(), {})
    content = bytearray(path.read_bytes())
    content[-1] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"model\.safetensors: sha256 .* is not the card's"):
        load_weights(path, Net())


@pytest.mark.parametrize("content", [b"", b"x", b"not safetensors" * 10])
def test_what_is_no_safetensors_file_is_refused(tmp_path, content):
    path = tmp_path / "model.safetensors"
    save_weights(path, Net(), {})
    path.write_bytes(content)
    with pytest.raises(InputError, match=r"model\.safetensors: cannot be read as safetensors"):
        load_weights(path, Net())


def test_truncated_and_missing_weights_are_named(tmp_path):
    path = tmp_path / "model.safetensors"
    save_weights(path, Net(), {})
    path.write_bytes(path.read_bytes()[:-20])
    with pytest.raises(InputError, match=r"model\.safetensors: "):
        load_weights(path, Net())
    path.unlink()
    with pytest.raises(InputError, match=r"model\.safetensors: "):
        load_weights(path, Net())


def test_weights_of_another_network_are_refused(tmp_path):
    save_weights(tmp_path / "model.safetensors", Net(width=4), {})
    with pytest.raises(InputError, match=r"model\.safetensors: weights of another network"):
        load_weights(tmp_path / "model.safetensors", Net(width=3))


def test_weights_without_a_readable_card_are_refused(tmp_path):
    path = tmp_path / "model.safetensors"
    save_weights(path, Net(), {})
    path.with_suffix(".json").write_text("{")
    with pytest.raises(InputError, match=r"model\.json: the weights' card cannot be read"):
        load_card(path)
    path.with_suffix(".json").unlink()
    with pytest.raises(InputError, match=r"model\.json: the weights' card cannot be read"):
        load_weights(path, Net())


@pytest.mark.parametrize("card", ["[]", "null", "3"])
def test_a_card_that_is_no_mapping_is_refused(tmp_path, card):
    path = tmp_path / "model.safetensors"
    save_weights(path, Net(), {})
    path.with_suffix(".json").write_text(card)
    with pytest.raises(InputError, match=r"model\.json: "):
        load_weights(path, Net())


def test_weights_in_a_pickle_are_refused_and_their_code_is_not_run(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(pickle.dumps(Trap(tmp_path / "mark")))
    path.with_suffix(".json").write_text(json.dumps({"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}))
    with pytest.raises(InputError, match="cannot be read as safetensors"):
        load_weights(path, Net())
    assert not (tmp_path / "mark").exists()


def test_a_checkpoint_makes_the_round_trip(tmp_path):
    net, optimizer = trained_net()
    path = save_checkpoint(tmp_path, 7, net, optimizer, recipe="abc")
    state = load_checkpoint(path)
    assert (state["recipe"], state["step"]) == ("abc", 7)
    assert equal(state["model"], net.state_dict())
    moments = optimizer.state_dict()["state"][0]
    assert torch.equal(state["optimizer"]["state"][0]["exp_avg_sq"], moments["exp_avg_sq"])
    assert list(tmp_path.iterdir()) == [path]


def test_there_may_be_no_checkpoint(tmp_path):
    assert last_checkpoint(tmp_path) is None
    assert last_checkpoint(tmp_path / "nowhere") is None


def test_the_newest_are_kept(tmp_path):
    net, optimizer = trained_net()
    for step in (9, 10, 11, 100):
        save_checkpoint(tmp_path, step, net, optimizer, recipe="abc", keep=3)
    assert [path.name for path in checkpoint_paths(tmp_path)] == [f"checkpoint_{step:08d}.pt" for step in (100, 11, 10)]
    assert last_checkpoint(tmp_path)["step"] == 100


@pytest.mark.parametrize("share", [0, 0.25, 0.5, 0.75, 0.999])
def test_a_damaged_checkpoint_is_told_and_the_one_before_it_is_used(tmp_path, share):
    net, optimizer = trained_net()
    paths = [save_checkpoint(tmp_path, step, net, optimizer, recipe="abc") for step in (7, 8)]
    paths[1].write_bytes(paths[1].read_bytes()[: int(share * paths[1].stat().st_size)])
    told = []
    assert last_checkpoint(tmp_path, told.append)["step"] == 7
    assert len(told) == 1 and "checkpoint_00000008.pt" in told[0]
    paths[0].write_bytes(b"")
    with pytest.raises(InputError, match=r"checkpoint_00000007\.pt: not a checkpoint"):
        last_checkpoint(tmp_path, told.append)


def test_one_changed_byte_of_a_tensor_is_noticed(tmp_path):
    net, optimizer = trained_net()
    path = save_checkpoint(tmp_path, 7, net, optimizer, recipe="abc")
    content = bytearray(path.read_bytes())
    place = content.find(next(net.parameters()).detach().numpy().tobytes())
    assert place > 0
    content[place + 1] ^= 1
    path.write_bytes(content)
    with pytest.raises(InputError, match="not a checkpoint of this project"):
        load_checkpoint(path)


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), RuntimeError("PytorchStreamWriter failed writing file")])
def test_a_failed_save_leaves_the_checkpoint_before_it(tmp_path, monkeypatch, error):
    net, optimizer = trained_net()
    before = save_checkpoint(tmp_path, 7, net, optimizer, recipe="abc")

    def full_disk(state, path):
        path.write_bytes(b"half")
        raise error

    monkeypatch.setattr(torch, "save", full_disk)
    with pytest.raises(OSError, match=r"No space left|failed writing"):
        save_checkpoint(tmp_path, 8, net, optimizer, recipe="abc")
    told = []
    Checkpointer(tmp_path, 1, 1, 1, told.append).save(8, net, optimizer, recipe="abc", parts=1, precision="float32")
    assert len(told) == 1 and "step 8 was not written" in told[0] and before.name in told[0]
    assert last_checkpoint(tmp_path)["step"] == 7
    assert list(tmp_path.iterdir()) == [before]


def test_a_checkpoint_is_due_by_steps_and_by_time(tmp_path, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(checkpoints.time, "monotonic", lambda: now[0])
    net, optimizer = trained_net()
    checkpointer = Checkpointer(tmp_path, 10, 2.0, 1, print)
    assert [step for step in range(1, 31) if checkpointer.due(step)] == [10, 20, 30]
    now[0] += 121
    assert checkpointer.due(3)
    checkpointer.save(3, net, optimizer, recipe="abc", parts=1, precision="float32")
    assert not checkpointer.due(4)


def write_foreign(kind, path, mark):
    if kind == "pickle":
        path.write_bytes(pickle.dumps(Trap(mark), protocol=2))
    elif kind == "trap in a torch file":
        torch.save({"recipe": Trap(mark), "parts": 1, "step": 1, "model": {}, "optimizer": {}}, path)
    elif kind == "other keys":
        torch.save({"epoch": 3}, path)
    elif kind == "a number":
        torch.save(3, path)
    elif kind == "truncated":
        torch.save({"recipe": "a", "parts": 1, "step": 1, "model": {"w": torch.rand(1000)}, "optimizer": {}}, path)
        path.write_bytes(path.read_bytes()[:2000])
    else:
        path.write_bytes(kind)


KINDS = ["pickle", "trap in a torch file", "other keys", "a number", "truncated", b"", b"x", b"PK\x03\x04 not a zip", b"\x80\x02."]


@pytest.mark.parametrize("kind", KINDS, ids=str)
def test_what_is_no_checkpoint_is_refused_in_one_line_and_its_code_is_not_run(tmp_path, kind):
    path = tmp_path / "checkpoint.pt"
    write_foreign(kind, path, tmp_path / "mark")
    with pytest.raises(InputError, match=r"checkpoint\.pt: not a checkpoint of this project") as error:
        load_checkpoint(path)
    assert "\n" not in str(error.value)
    assert not (tmp_path / "mark").exists()


def test_weights_of_a_save_that_was_killed_between_card_and_weights_are_not_taken_as_done(tmp_path):
    path = tmp_path / "model.safetensors"
    assert finished_card(path) is None
    save_weights(path, Net(), {"recipe": "old"})
    assert finished_card(path)["recipe"] == "old"
    card = path.with_suffix(".json")
    card.write_text(card.read_text().replace("old", "new").replace('"sha256": "', '"sha256": "0'))
    assert finished_card(path) is None


def test_weights_may_be_read_by_whom_their_card_may(tmp_path):
    save_weights(tmp_path / "model.safetensors", Net(), {})
    assert (tmp_path / "model.safetensors").stat().st_mode == (tmp_path / "model.json").stat().st_mode
