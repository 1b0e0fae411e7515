"""The bench times the parts of a training step, and its verdict on a GPU can be had on a CPU, too."""

import functools
import json

import pytest
import torch

from dualdepth.profile import load_profile
from tools import bench_gpu
from tools.bench import beside_a_peer, floors, inference_parts, make_net, timed_steps
from tools.peer import Peer


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lr", "dual"])
def test_a_step_is_timed_by_its_parts(name, encoder):
    training = load_profile("tiny").training.model_copy(update={"encoder": encoder})
    images = torch.randint(0, 255, (1, 3, 3, 192, 192), dtype=torch.uint8)
    matrix = torch.tensor([[[200.0, 0, 96], [0, 200, 96], [0, 0, 1]]])
    batch = {"images": images, "intrinsics": matrix}
    found = {part: values[0] for part, values in timed_steps(name, training, batch, torch.device("cpu"), 1).items()}
    parts = [found.pop(part) for part in ("networks", "losses", "backward", "optimiser")]
    assert min(parts) > 0 and sum(parts) == pytest.approx(found["step"]) and found["peak_mb"] > 100
    floor = floors(name, training, batch, torch.device("cpu"), "float32")
    assert (floor["backward"] == pytest.approx(2 * floor["networks"])) == (name == "lr") and min(floor.values()) > 0


@pytest.mark.slow
def test_a_peers_step_is_timed_beside_ours_and_inference_by_its_parts(encoder):
    training = load_profile("tiny").training.model_copy(update={"precision": "float32"})
    batch = {"images": torch.randint(0, 255, (1, 3, 3, 192, 192), dtype=torch.uint8), "intrinsics": torch.eye(3)[None]}
    found = beside_a_peer(training, batch, torch.device("cpu"), 2)
    assert {name: len(values) for name, values in found.items()} == {"ours": 2, "plain": 2, "peer": 2}
    assert min(min(values) for values in found.values()) > 0
    parts = inference_parts(make_net("dual", encoder).eval(), torch.rand(1, 3, 192, 192), "float32", 1)
    whole = parts.pop("whole")[0]
    assert len(parts) == 3 and min(parts.values())[0] > 0 and sum(values[0] for values in parts.values()) < whole


def test_the_peers_depth_network_has_the_papers_size():
    depth_net = Peer().depth_net
    classifier = 512 * 1000 + 1000  # HR-Depth (Lyu et al., 2021) counts 14.84 million with it
    assert sum(p.numel() for p in depth_net.parameters()) + classifier == pytest.approx(14.84e6, rel=1e-3)


@pytest.mark.slow
def test_a_verdict_is_found_on_the_device_at_hand(monkeypatch, tmp_path, encoder):
    monkeypatch.setattr(torch, "compile", functools.partial(torch.compile, backend="eager"))  # all but the code, which takes minutes
    left_out = [trial for trial in bench_gpu.TRIALS if trial.batch > 4 or (trial.compiled and (trial.again or trial.stage == "hr"))]
    monkeypatch.setattr(bench_gpu, "TRIALS", [trial for trial in bench_gpu.TRIALS if trial not in left_out])
    (tmp_path / "own.yaml").write_text(f"extends: paper\nabout: a\ndata: {{hr_size: [192, 288]}}\ntraining: {{encoder: {encoder}}}\n")
    options = ["--device", "cpu", "--steps", "3", "--workers", "1", "--profile", str(tmp_path / "own.yaml")]
    assert bench_gpu.main([*options, "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out.json").read_text())
    assert not [row for row in found["rows"] if "error" in row] and found["verdicts"]["hr: two runs equal to the bit"]
    assert {"lr: time of a step, eager / compiled", "hr: time of a step, deterministic / not"} <= found["verdicts"].keys()
    assert found["verdicts"]["lr: hours of own on 39810 triplets"] == pytest.approx(398_080 * found["rows"][0]["step_s"] / 3600)
