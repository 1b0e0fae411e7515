"""Stage 2 asks in one line for what it needs."""

import pytest
from small_stages import after_stage_1, backbones, change_card, quiet_torch, run_in, trained  # noqa: F401

from dualdepth.errors import InputError
from dualdepth.training.variants import train_variant

# ruff: noqa: F811


def tamper(run):
    content = bytearray(run.weights("lr", 0).read_bytes())
    content[-1] ^= 1
    run.weights("lr", 0).write_bytes(content)


WEIGHTS, CARD = r"/runs/lr/seed0/model\.safetensors", r"/runs/lr/seed0/model\.json"
OF_BEFORE = {"network": {"encoder": "resnet50", "hr_size": [192, 192]}, "encoder": None, "hr_size": None}
SPOILT = {
    "no weights": (
        lambda run: run.weights("lr", 0).unlink(),
        rf"^work/own{WEIGHTS} is missing: run notebook 03_train_lr, variant lr, seed 0",
    ),
    "no card": (lambda run: run.weights("lr", 0).with_suffix(".json").unlink(), f"{CARD}: .*; keep it beside the weights$"),
    "tampered": (tamper, f"{WEIGHTS}: sha256 .*; the file was changed, copy it again$"),
    "another network": (lambda run: change_card(run, network="dual"), f"{WEIGHTS}: its card has network 'dual' .*; train lr again"),
    "another version's card": (lambda run: change_card(run, **OF_BEFORE), f"{WEIGHTS}: its card has network .*; train lr again"),
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


@pytest.mark.parametrize("name", ["dual", "hr_only"])
@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"encoder": "other"}, r"encoder '\S*usual\S*' instead of '\S*other\S*'"),
        ({"hr_size": (192, 288)}, r"hr_size \[192, 192\] instead of \[192, 288\]"),
    ],
    ids=["backbone", "size"],
)
def test_stage_1_of_another_backbone_or_size_is_refused(after_stage_1, backbones, name, change, said):
    run = after_stage_1(**{key: getattr(backbones, value) if key == "encoder" else value for key, value in change.items()})
    said = rf"/runs/lr/seed0/model\.safetensors: its card has {said}; train lr again with this profile$"
    with pytest.raises(InputError, match=said) as error:
        train_variant(run, name, 0)
    assert "\n" not in str(error.value)
    assert not run.weights(name, 0).exists()


def test_stage_1_of_another_seed_does_not_do(after_stage_1):
    with pytest.raises(InputError, match=r"^work/own/runs/lr/seed1/model\.safetensors is missing: .* variant lr, seed 1, "):
        train_variant(after_stage_1(), "dual", 1)


def test_an_unknown_variant_is_an_error_that_names_the_nearest(trained):
    with pytest.raises(InputError, match=r"^variant 'duel' is unknown; did you mean dual\? There are lr, dual, .*one_network$"):
        train_variant(trained, "duel", 0)
