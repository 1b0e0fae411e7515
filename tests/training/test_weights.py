"""Released weights and their cards: what is written reads back, and nothing else is taken for it."""

import hashlib
import json
import pickle

import pytest
import torch
from small_nets import Net, Trap, equal, trained_net
from torch import nn

from dualdepth.errors import InputError
from dualdepth.training.weights import HUB_CARD, finished_card, load_card, load_weights, save_weights
from tools.publish import in_8_bits


@pytest.fixture
def path(tmp_path):
    """Weights with their card."""
    save_weights(tmp_path / "model.safetensors", trained_net()[0], {"profile": "tiny", "seed": 3})
    return tmp_path / "model.safetensors"


@pytest.mark.parametrize("card_name", [None, HUB_CARD])
def test_weights_and_card_make_the_round_trip(tmp_path, card_name):
    net, _ = trained_net()
    path = tmp_path / "model.safetensors"
    save_weights(path, net, {"profile": "tiny", "seed": 3}, card_name)
    other = Net()
    card = load_weights(path, other)
    assert equal(other.state_dict(), net.state_dict())
    assert card == {"profile": "tiny", "seed": 3, "sha256": hashlib.sha256(path.read_bytes()).hexdigest()}
    assert sorted(p.name for p in tmp_path.iterdir()) == [card_name or "model.json", "model.safetensors"]


def test_large_tensors_are_kept_in_8_bits_to_half_a_step_of_their_channel_and_small_ones_as_they_are(tmp_path):
    net = nn.Conv2d(64, 32, 3)
    with torch.no_grad():
        net.weight[3] *= 100.0
        net.weight[4] = 0.0
    path, other = tmp_path / "model.safetensors", nn.Conv2d(64, 32, 3)
    save_weights(path, in_8_bits(net.state_dict()), {})
    load_weights(path, other)
    half_step = net.weight.abs().amax(dim=(1, 2, 3), keepdim=True) / 254
    assert ((other.weight - net.weight).abs() <= half_step * 1.001).all() and torch.equal(other.bias, net.bias)
    assert path.stat().st_size < 0.3 * 4 * net.weight.numel()


def test_weights_that_are_changed_no_safetensors_file_or_of_another_network_are_refused(path):
    with pytest.raises(InputError, match=r"model\.safetensors: weights of another network"):
        load_weights(path, Net(width=4))
    whole = path.read_bytes()
    damaged = dict.fromkeys((b"", b"x", b"not safetensors" * 10, whole[:-20]), "cannot be read")
    for content, said in (damaged | {whole[:-1] + bytes([whole[-1] ^ 1]): "sha256 .* is not the card's"}).items():
        path.write_bytes(content)
        with pytest.raises(InputError, match=rf"model\.safetensors: {said}"):
            load_weights(path, Net())
    path.unlink()
    with pytest.raises(InputError, match=r"model\.safetensors: "):
        load_weights(path, Net())
    path.with_suffix(".json").unlink()
    with pytest.raises(InputError, match=r"model\.safetensors: no such file; give the weights of a training$"):  # not: that a card lacks
        load_card(path)


@pytest.mark.parametrize("card", [None, "{", "[]", "null", "3", '{"drives": "all"}', '{"drives": [1]}'])
def test_weights_without_a_readable_card_are_refused(path, card):
    file = path.with_suffix(".json")
    file.unlink() if card is None else file.write_text(card)
    for read in (load_card, finished_card, lambda path: load_weights(path, Net())):
        with pytest.raises(InputError, match=r"model\.json: .*; keep the weights' card beside them"):
            read(path)


def test_weights_in_a_pickle_are_refused_and_their_code_is_not_run(tmp_path):
    path = tmp_path / "model.safetensors"
    path.write_bytes(pickle.dumps(Trap(tmp_path / "mark")))
    path.with_suffix(".json").write_text(json.dumps({"sha256": hashlib.sha256(path.read_bytes()).hexdigest()}))
    with pytest.raises(InputError, match="cannot be read"):
        load_weights(path, Net())
    assert not (tmp_path / "mark").exists()


def test_weights_of_a_save_that_was_killed_between_card_and_weights_are_not_taken_as_done(path, tmp_path):
    assert finished_card(tmp_path / "none.safetensors") is None and finished_card(path)["seed"] == 3 == load_card(tmp_path)["seed"]
    card = path.with_suffix(".json")
    card.write_text(card.read_text().replace('"sha256": "', '"sha256": "0'))
    assert finished_card(path) is None


def test_weights_may_be_read_by_whom_their_card_may(path):
    assert path.stat().st_mode == path.with_suffix(".json").stat().st_mode
