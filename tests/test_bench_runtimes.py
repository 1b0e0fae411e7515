"""Latencies side by side: who cannot run says why, and the others are measured all the same."""

import math

import pytest
import torch

from dualdepth import bench_runtimes
from dualdepth.errors import InputError


def test_each_takes_its_turn_and_the_first_turn_does_not_count(monkeypatch):
    clock, order = [0.0], []
    monkeypatch.setattr(bench_runtimes.time, "perf_counter", lambda: clock[0])

    def lasts(name, *seconds):
        left = list(seconds)

        def run():
            order.append(name)
            clock[0] += left.pop(0)

        return run

    assert bench_runtimes.in_turns({"a": lasts("a", 9, 1, 5, 2), "b": lasts("b", 9, 4, 3, 8)}, 3) == {"a": 2, "b": 4}
    assert order == ["a", "b"] * 4


def test_without_a_compiler_and_a_package_it_says_so_and_measures_pytorch(monkeypatch):
    def no_compiler(net):
        def run(image):
            raise RuntimeError("InvalidCxxCompiler: no working C++ compiler found\nand more")

        return run

    def no_package(*names):
        raise InputError("package onnx is not installed")

    monkeypatch.setattr(torch, "compile", no_compiler)
    monkeypatch.setattr(bench_runtimes, "require_packages", no_package)
    rows = bench_runtimes.runtimes(1, "mobilenet_v2", (192, 192))
    assert [what for what, _, _ in rows] == [
        "inference, dual 192x192, float32, CPU, PyTorch",
        "  compiled PyTorch: cannot be compiled here (InvalidCxxCompiler: no working C++ compiler found);"
        " torch.compile needs a C++ compiler, such as g++",
        "  ONNX Runtime: package onnx is not installed",
    ]
    assert rows[0][1] > 0 and all(math.isnan(value) for _, value, _ in rows[1:])


@pytest.mark.slow
def test_onnx_runtime_is_measured_beside_pytorch(monkeypatch):
    layouts = set()

    def compiled(net):  # which takes a minute, and again whenever a layout has changed
        def run(image):
            layouts.add((image.stride(), *(parameter.stride() for parameter in net.parameters())))
            return net(image)

        return run

    monkeypatch.setattr(torch, "compile", compiled)
    rows = {what: value for what, value, _ in bench_runtimes.runtimes(1, "mobilenet_v2", (192, 192))}
    times = {name: rows[f"inference, dual 192x192, float32, CPU, {name}"] for name in ("PyTorch", "compiled PyTorch", "ONNX Runtime")}
    assert all(value > 0 for value in times.values())
    assert rows["  ONNX Runtime / PyTorch"] == pytest.approx(times["ONNX Runtime"] / times["PyTorch"])
    assert len(layouts) == 1
