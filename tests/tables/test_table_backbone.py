"""The overhead table: costs like the paper's, the paper's rows, and what ImageNet weights bring or why that is not known."""

import contextlib
import math

import pytest
import torch

from dualdepth import paper
from dualdepth.evaluation.cost import Latency, count
from dualdepth.networks.architecture import Architecture
from dualdepth.networks.attention import STARTING_RMS
from dualdepth.tables import backbone
from dualdepth.tables.backbone import NETWORKS, NO_WEIGHTS, WITHOUT_DECODER, backbone_scores, backbone_table, cost_row, let_see
from dualdepth.tables.rows import claims_table

PRETRAINED = "training: {{pretrained: {}}}\n"
VALUES = {"mobilenet_v2": 0.5, "resnet18": 0.4, "dual": 0.2, "lr": 0.3, "dual_scratch": 0.25}


@pytest.fixture
def latencies(monkeypatch):
    """Networks have shapes only, and their time is not measured: what would be is recorded."""
    asked = []

    def latency(model, image, *, repeats, precision, **options):
        asked.append((image.shape[2:], sum(p.numel() for p in model.parameters()), repeats, precision))
        return Latency(7.0 if precision == "float32" else 3.0, 100.0 if precision == "float32" else 60.0)

    monkeypatch.setattr(backbone, "latency", latency)
    monkeypatch.setattr(backbone, "default_device", lambda: "meta")
    monkeypatch.setattr(backbone, "let_see", lambda net, image: net)
    monkeypatch.setattr(backbone, "has_bf16", lambda device: True)
    monkeypatch.setattr(backbone, "device_name", lambda: "a device, 2 threads")
    monkeypatch.setattr(torch, "autocast", lambda *_, **__: contextlib.nullcontext())  # it knows no tensors without values
    with torch.device("meta"):
        yield asked


@pytest.fixture
def scored(make_scores, give):
    give(lambda variant, seed: make_scores(VALUES[variant] + 0.02 * seed))


def table_of(run, seeds, repeats=3):
    return backbone_table(run, backbone_scores(run, seeds), repeats)


@pytest.fixture
def cheap(monkeypatch):
    monkeypatch.setattr(backbone, "cost_row", lambda name, repeats: {"params_m": float(repeats), "gmacs": 2.0})
    monkeypatch.setattr(backbone, "has_bf16", lambda device: True)


@pytest.mark.parametrize("name", NETWORKS)
def test_time_and_memory_are_of_the_network_that_the_row_names_at_the_papers_size(name, latencies):
    row = cost_row(name, 4)
    size, params = (128, 416) if name.startswith("LR-Net") else (384, 1248), round(1e6 * row["params_m"])
    assert latencies == [(size, params, 4, "float32"), (size, params, 4, "bf16")]
    times = [row[name] for name in ("latency_ms", "latency_ms_bf16", "peak_mb", "peak_mb_bf16")]
    assert times == [7, 3, 100, 60] and row["device"] == "a device, 2 threads"


def test_a_network_with_new_weights_is_timed_after_it_has_seen_an_image():
    net = let_see(Architecture(network="dual", encoder="resnet18").build(), torch.rand(1, 3, 192, 288))
    assert float(net.attention.scale) == pytest.approx(STARTING_RMS, rel=0.01) and not net.training


def test_without_lr_nets_decoder_its_parameters_and_operations_are_missing(latencies):
    lr_net, low = Architecture(network="lr", encoder="resnet50").build(), torch.zeros(1, 3, 128, 416)
    alone, encoder = count(lr_net, low), count(lr_net.encoder, low)
    lr, whole, without = (cost_row(name, 1) for name in ("LR-Net (ResNet50)", "Dual-network (ResNet50)", WITHOUT_DECODER))
    assert (lr["params_m"], lr["gmacs"]) == pytest.approx((alone.params / 1e6, alone.macs / 1e9), rel=1e-12)
    assert whole["params_m"] - without["params_m"] == pytest.approx((alone.params - encoder.params) / 1e6)
    assert whole["gmacs"] - without["gmacs"] == pytest.approx((alone.macs - encoder.macs) / 1e9)


def test_what_a_device_only_imitates_is_not_measured_and_the_row_says_so(latencies, scored, make_run, monkeypatch):
    monkeypatch.setattr(backbone, "has_bf16", lambda device: False)
    row = cost_row("LR-Net (ResNet50)", 4)
    assert [precision for *_, precision in latencies] == ["float32"]
    assert row["latency_ms"] == 7 and row["latency_ms_bf16"] != row["latency_ms_bf16"]
    monkeypatch.setattr(backbone, "cost_row", lambda name, repeats: row)
    measured = table_of(make_run(), [0]).query("source == 'measured'").set_index("backbone")
    assert "bf16 not measured" in measured.loc["ResNet18", "note"]


def test_each_network_has_its_cost_and_the_metrics_of_its_training(scored, cheap, make_run, check_paper_rows):
    table = table_of(make_run(), [0, 1], repeats=9)
    check_paper_rows(table, paper.table("backbone"))
    measured = table.query("source == 'measured'").set_index("backbone")
    variants = {name: variant for name, (_, variant) in NETWORKS.items()}
    assert list(measured.index[:5]) == list(variants)
    for name, variant in variants.items():
        row = measured.loc[name]
        assert row["variant"] == variant and row["params_m"] == 9 and row["gmacs"] == 2
        assert row["abs_rel"] == pytest.approx(VALUES[variant] + 0.01)
        assert row["abs_rel_std"] == pytest.approx(0.02 / 2**0.5)
        assert row["note"].startswith(f"cost of a new network at the paper's size; metrics of variant {variant}: resnet18, ")


def test_what_is_not_trained_has_its_cost_and_without_imagenet_weights_their_row_says_not_run(scored, cheap, make_run):
    measured = table_of(make_run("own", kitti=PRETRAINED.format("false")), [0]).query("source != 'paper'").set_index("backbone")
    assert measured.index[-2:].tolist() == ["w/ pt", "w/o pt"]
    row = measured.loc["MobileNet V2"]
    assert row["gmacs"] == 2 and row["abs_rel"] != row["abs_rel"]
    assert row["source"] == "measured" and row["reason"] == "profile own does not train mobilenet_v2"
    row = measured.loc["w/ pt"]
    assert row["source"] == "not run" and row["reason"] == NO_WEIGHTS and row["abs_rel"] != row["abs_rel"]
    assert measured.loc["w/o pt", "variant"] == "dual" and measured.loc["w/o pt", "abs_rel"] == pytest.approx(0.2)
    assert "no ImageNet weights" in measured.loc["w/o pt", "note"]


def test_with_imagenet_weights_both_rows_have_their_training(scored, cheap, make_run, cards):
    cards["dual"] = {"pretrained": True}
    text = PRETRAINED.format("true") + "train: {lr: , lr_scratch: , dual: , dual_scratch: }\n"
    measured = table_of(make_run("own", kitti=text), [0]).query("source == 'measured'").set_index("backbone")
    assert measured.loc["w/ pt", "abs_rel"] == pytest.approx(0.2) and measured.loc["w/ pt", "variant"] == "dual"
    assert measured.loc["w/o pt", "abs_rel"] == pytest.approx(0.25) and measured.loc["w/o pt", "variant"] == "dual_scratch"
    assert "no ImageNet" not in measured.loc["w/ pt", "note"] and "no ImageNet" in measured.loc["w/o pt", "note"]


ALL = "train: {lr: , lr_scratch: , dual: , dual_scratch: , resnet18: , mobilenet_v2: }\n"


@pytest.mark.parametrize("pretrained", [True, False])
def test_claims_are_compared_with_the_better_one_first_and_like_with_like(scored, make_run, cards, pretrained):
    cards["dual"] = {"pretrained": pretrained}  # the others began without
    run = make_run("own", kitti=PRETRAINED.format(str(pretrained).lower()) + ALL)
    table = claims_table(backbone_scores(run, [0, 1]), "backbone")
    errors = table[table["metric"] != "a1"].set_index("b")
    firsts = ["dual_scratch", "dual_scratch", "dual"] if pretrained else ["dual", "dual", "dual"]
    assert list(errors.index) == ["resnet18", "mobilenet_v2", "dual_scratch"] and errors["a"].tolist() == firsts
    assert errors["reason"].tolist() == ["", "", "" if pretrained else NO_WEIGHTS]
    expected = [VALUES[a] - VALUES[b] if pretrained or b != "dual_scratch" else math.nan for a, b in zip(firsts, errors.index)]
    assert errors["difference"].tolist() == pytest.approx(expected, nan_ok=True)
