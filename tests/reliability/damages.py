"""How good files are made bad: each damage takes the good file's bytes and gives the bad one's."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable

import numpy as np
from PIL import Image
from worlds import tar_of

Damage = Callable[[bytes], bytes | None]
"""None: the file is removed."""


def text(content: str | bytes) -> Damage:
    """A file with another content."""
    return lambda _: content.encode() if isinstance(content, str) else content


def replaced(old: str, new: str) -> Damage:
    """A text with some words replaced, which must be in it."""

    def damage(whole: bytes) -> bytes:
        assert old.encode() in whole
        return whole.replace(old.encode(), new.encode(), 1)

    return damage


def turned(share: float) -> Damage:
    """One byte changed, at a share of the file."""
    return lambda whole: whole[: (at := int(share * len(whole)))] + bytes([whole[at] ^ 0x55]) + whole[at + 1 :]


QUARTERS: dict[str, Damage] = {
    f"truncated at {share:g}": lambda whole, share=share: whole[: int(share * len(whole))] for share in (0.25, 0.5, 0.75)
}
NO_FILE: dict[str, Damage] = {
    "missing": lambda _: None,
    "zero bytes": text(b""),
    "a web page": text("<html>404 not found</html>"),
    "random bytes": text(np.random.default_rng(0).bytes(5000)),
}


def encoded(picture: Image.Image, kind: str = "png", **settings) -> bytes:
    """A picture as a file."""
    buffer = io.BytesIO()
    picture.save(buffer, kind, **settings)
    return buffer.getvalue()


def image(mode: str, kind: str = "png", **settings) -> Damage:
    """The same picture in another mode or format."""
    return lambda whole: encoded(Image.open(io.BytesIO(whole)).convert(mode), kind, **settings)


def deep(whole: bytes) -> bytes:
    """The same picture, grey, with 16 bits."""
    return encoded(Image.fromarray(np.asarray(Image.open(io.BytesIO(whole)).convert("L")).astype(np.uint16) * 257))


def png_of_gigapixels(whole: bytes) -> bytes:
    """A header with a right checksum that announces 40,000 x 40,000 pixels."""
    size = whole[12:16] + struct.pack(">II", 40_000, 40_000) + whole[24:29]
    return whole[:12] + size + struct.pack(">I", zlib.crc32(size)) + whole[33:]


def jpeg_of_gigapixels(whole: bytes) -> bytes:
    """A frame header that announces 65,500 x 65,500 pixels."""
    at = whole.index(b"\xff\xc0") + 5
    return whole[:at] + struct.pack(">HH", 65_500, 65_500) + whole[at + 4 :]


def smaller(whole: bytes) -> bytes:
    """The same picture at another size."""
    return encoded(Image.open(io.BytesIO(whole)).resize((100, 90)))


def npz_of(**arrays: np.ndarray) -> Damage:
    """Another archive of arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return text(buffer.getvalue())


def npz_bomb(whole: bytes) -> bytes:
    """Members that announce 4.2 GB each, in the archive's directory."""
    at = whole.index(b"PK\x01\x02")
    return whole[:at] + whole[at : at + 24] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 28 :]


def swelling(_: bytes) -> bytes:
    """A zip of half a megabyte that unpacks to 500."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, archive.open("zeros.bin", "w") as member:
        for _ in range(500):
            member.write(bytes(10**6))
    return buffer.getvalue()


def grids(content: bytes) -> Damage:
    """An archive of one laser grid."""
    return lambda _: tar_of({"depth_sph_corr-a.mat": content})
