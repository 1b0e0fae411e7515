"""Which machine this is: bf16 where the device has it, unless the profile says otherwise; memory is kept where glibc can."""

import ctypes
from pathlib import Path
from unittest.mock import Mock

import pytest
import torch

from dualdepth.device import choose_device, choose_precision, has_bf16, inference_precision, keep_freed_memory
from dualdepth.errors import InputError

CPU, GPU = torch.device("cpu"), torch.device("cuda")


@pytest.mark.parametrize(
    ("instructions", "size", "expected"),
    [
        ({"avx2": True}, (128, 416), "float32"),
        ({"avx512_f": True, "avx512_bf16": False}, (128, 416), "float32"),
        ({"avx512_bf16": True}, (128, 416), "bf16"),
        ({"amx_bf16": True}, (128, 416), "bf16"),
        ({"amx_bf16": True}, (64, 64), "float32"),
    ],
)
def test_a_cpu_computes_in_bf16_if_it_has_instructions_for_it_unless_the_profile_says_otherwise(monkeypatch, instructions, size, expected):
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: instructions)
    assert [choose_precision(setting, CPU, size) for setting in ("auto", "float32", "bf16")] == [expected, "float32", "bf16"]


@pytest.mark.parametrize("has", [True, False])
def test_a_gpu_that_only_imitates_bf16_computes_in_float32(monkeypatch, has):
    monkeypatch.setattr(torch.cuda, "is_bf16_supported", lambda including_emulation=True: including_emulation or has)
    expected = "bf16" if has else "float32"
    assert choose_precision("auto", GPU, (128, 416)) == inference_precision(None, GPU) == expected


def test_this_cpu_says_the_same_as_its_operating_system():
    file = Path("/proc/cpuinfo")
    if not file.exists():
        pytest.skip("no /proc/cpuinfo here")
    assert has_bf16(CPU) == bool({"avx512_bf16", "amx_bf16"} & set(file.read_text(encoding="utf-8").split()))


def test_device_and_precision_of_predictions_are_chosen_and_settable(monkeypatch):
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 0)
    monkeypatch.setattr(torch.backends.mps, "is_available", lambda: False)
    assert choose_device(None) == CPU
    for wrong in ("cuda", "cuda:0", "mps", "tpu", "xyz:9"):
        with pytest.raises(InputError, match=f"'{wrong}' .* there are cpu"):
            choose_device(wrong)
    monkeypatch.setattr(torch.cuda, "device_count", lambda: 2)
    assert [str(choose_device(d)) for d in (None, "cpu", "cuda:1")] == ["cuda", "cpu", "cuda:1"]
    with pytest.raises(InputError, match="cuda:2"):
        choose_device("cuda:2")
    assert inference_precision(None, CPU) == "float32"
    with pytest.raises(InputError, match="'fp8'"):
        inference_precision("fp8", CPU)


@pytest.mark.parametrize("library", [OSError("no libc.so.6"), object()])
def test_an_allocator_that_is_not_glibcs_is_left_alone(monkeypatch, library):
    monkeypatch.setattr(ctypes, "CDLL", Mock(side_effect=[library]))
    keep_freed_memory()
