"""Freed memory stays in the process where the allocator is glibc's, and nothing happens elsewhere."""

import ctypes
import platform
import subprocess
import sys

import pytest

from dualdepth import device

COUNT = """
import resource, sys
import numpy as np
from dualdepth.memory import keep_freed_memory
assert not int(sys.argv[1]) or keep_freed_memory()
np.ones(1 << 23)
before = resource.getrusage(resource.RUSAGE_SELF).ru_minflt
for _ in range(20):
    np.ones(1 << 23)  # 64 MiB
print(resource.getrusage(resource.RUSAGE_SELF).ru_minflt - before)
"""


@pytest.mark.skipif(platform.libc_ver()[0] != "glibc", reason="the C library is not glibc")
def test_large_arrays_are_not_paged_in_again():
    faults = [int(subprocess.run([sys.executable, "-c", COUNT, kept], capture_output=True, check=True).stdout) for kept in "01"]
    assert faults[0] > 500 > 5 * faults[1]  # 20 times 32 huge pages of 2 MiB, or very many small ones


@pytest.mark.parametrize("library", [OSError("no libc.so.6"), object()])
def test_another_allocator_is_left_alone(monkeypatch, library):
    def load(name):
        if isinstance(library, Exception):
            raise library
        return library

    monkeypatch.setattr(ctypes, "CDLL", load)
    assert device.keep_freed_memory() is False
