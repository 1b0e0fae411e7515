"""Numeric arrays of MATLAB's level 5 files (MathWorks, "MAT-File Format").

SciPy's reader is not used: on damaged files SciPy 1.17 can end the process, since it looks an unknown type of numbers up beyond its table.
"""

import struct
import zlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 9: "f8", 12: "i8", 13: "u8"}
"""NumPy's names of the format's types of numbers."""
NUMERIC = [bytes([number]) for number in range(6, 16)]
"""Classes of arrays that hold numbers: double, single, and whole ones of 8 to 64 bits."""
MATRIX, COMPRESSED = 14, 15
LARGEST = 10**8
"""Bytes that a variable may unpack to; a grid of Make3D takes half a million."""


def read_mat(path: str | Path, name: str) -> np.ndarray | None:
    """The array `name`, with numbers as they are stored (MATLAB keeps small whole ones in bytes), or None where there is none.

    Raises:
        OSError: the file cannot be read.
        ValueError: it is damaged, no such file, or the variable is no plain array of numbers.
    """
    data = Path(path).read_bytes()
    order = {b"IM": "<", b"MI": ">"}.get(data[126:128])
    if order is None:
        raise ValueError("no header of MATLAB 5")
    for kind, body in _elements(data[128:], order):
        if kind == COMPRESSED:
            kind, body = next(_elements(_inflated(body), order), (0, b""))
        if kind != MATRIX:
            continue
        flags, shape, label, *values = _elements(body, order)
        if label[1].rstrip(b"\0") == name.encode():
            array_class = flags[1][:1] if order == "<" else flags[1][3:4]
            if array_class not in NUMERIC or not values or values[0][0] not in TYPES:
                raise ValueError(f"{name} is no plain array; expected numbers")
            return np.frombuffer(values[0][1], order + TYPES[values[0][0]]).reshape(np.frombuffer(shape[1], order + "i4"), order="F")
    return None


def _elements(data: bytes, order: str) -> Iterator[tuple[int, bytes]]:
    """Type and bytes of each element."""
    at = 0
    while at + 8 <= len(data):
        kind, size = struct.unpack_from(f"{order}II", data, at)
        start, end = at + 8, at + 8 + size
        if kind >> 16:  # up to four bytes stand in the tag itself
            kind, size, start, end = kind & 0xFFFF, kind >> 16, at + 4, at + 8
        if start + size > len(data):
            raise ValueError("truncated")
        yield kind, data[start : start + size]
        at = end if kind == COMPRESSED else end + -end % 8


def _inflated(body: bytes) -> bytes:
    unpacking = zlib.decompressobj()
    try:
        data = unpacking.decompress(body, LARGEST)
    except zlib.error as error:
        raise ValueError(str(error)) from None
    if not unpacking.eof:
        raise ValueError(f"truncated, or a variable of more than {LARGEST} bytes")
    return data
