"""Hypothesis strategies that damage whole files, and the settings of all fuzzing here."""

import os

from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from dualdepth.errors import InputError

LONG = os.environ.get("DUALDEPTH_EXAMPLES")
FUZZ = settings(
    max_examples=int(LONG or 40),  # an example is one damaged file
    derandomize=not LONG,  # CI tries the same files each time, the long form always others
    database=None,
    deadline=None,
    suppress_health_check=list(HealthCheck),
)
"""40 examples a parser, or as many as DUALDEPTH_EXAMPLES says."""

WORDS = [
    *["nan", "-inf", "1e999", "-1", "0", "1_0", "0x10", "²", "٣"],
    *("9" * 400, "1e308", "--", "''", "\x00", "\ufeff", "\u2028", "\r", "\n", "\t", ":", ",", "{", "["),
    *("!!python/object:os.system", "&a", "*a", "2001-99-99", "null", "true", "../..", "/etc/passwd", "ñ ö.png"),
]
"""What text parsers stumble over."""


def fuzz(counted, read, *strategies):
    """Read many examples; nothing but a refusal in words may be raised."""

    @FUZZ
    @given(st.tuples(*strategies))
    def try_one(values):
        with counted():
            read_or_refuse(read, *values)

    try_one()


def read_or_refuse(read, *values):
    """Read; gives None for a refusal in words."""
    try:
        return read(*values)
    except InputError as error:
        assert str(error)
        return None


@st.composite
def bytes_of(draw, whole: bytes, words: bool = False) -> bytes:
    """`whole` with one to four damages: cut, overwritten, deleted, repeated, a bit turned, or (text) a word put in; or any bytes."""
    if draw(st.integers(0, 9)) == 0:
        return draw(st.binary(max_size=200))
    data = bytearray(whole)
    for _ in range(draw(st.integers(1, 4))):
        at = draw(st.integers(0, len(data)))
        length = draw(st.sampled_from([0, 1, 2, 4, 8, 64]))
        kind = draw(
            st.sampled_from(["word", "word", "line", "delete", "overwrite"] if words else ["bit", "overwrite", "delete", "repeat", "cut"])
        )
        if kind == "cut":
            del data[at:]
        elif kind == "bit" and at < len(data):
            data[at] ^= 1 << draw(st.integers(0, 7))
        elif kind == "overwrite":
            data[at : at + length] = draw(
                st.one_of(st.binary(min_size=length, max_size=length), st.sampled_from([b"\x00", b"\xff"]).map(lambda b, n=length: b * n))
            )
        elif kind == "delete":
            del data[at : at + length]
        elif kind == "repeat":
            data[at:at] = data[at : at + length] * draw(st.integers(1, 3))
        elif kind == "word":
            gaps = [0, *(i for i, b in enumerate(data) if chr(b) in " \n:,/[]{}\"'"), len(data)]  # where words begin or end
            at = draw(st.sampled_from(gaps))
            end = draw(st.sampled_from([at, *(g for g in gaps if g > at)][:3]))
            data[at:end] = draw(st.sampled_from(WORDS)).encode()
        elif kind == "line":
            lines = bytes(data).split(b"\n")
            lines.insert(draw(st.integers(0, len(lines))), draw(st.sampled_from(lines)))
            data = bytearray(b"\n".join(lines))
    return bytes(data)


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.integers(-(10**20), 10**20)
    | st.floats()
    | st.text(max_size=8)
    | st.sampled_from(["lr", "cpu", "/", "a\0b"]),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=6), inner, max_size=3),
    max_leaves=6,
)
"""Any value of JSON."""


@st.composite
def values_of(draw, whole):
    """A value of JSON with some of its parts replaced, removed or added; all of it may be another value."""
    if draw(st.integers(0, 4)) == 4:
        return draw(JSON)
    if isinstance(whole, dict) and whole:
        name = draw(st.sampled_from(sorted(whole)))
        action = draw(st.sampled_from(["deeper", "deeper", "remove", "add"]))
        if action == "remove":
            return {k: v for k, v in whole.items() if k != name}
        if action == "add":
            return whole | {draw(st.text(max_size=6)): draw(JSON)}
        return whole | {name: draw(values_of(whole[name]))}
    if isinstance(whole, list) and whole:
        at = draw(st.integers(0, len(whole) - 1))
        return [*whole[:at], draw(values_of(whole[at])), *whole[at + 1 :]]
    return draw(JSON)
