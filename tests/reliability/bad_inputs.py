"""The table of bad and of odd inputs: what is damaged, and how; or what is odd and works."""

import io
import pickle
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from loopback import zip_of
from PIL import Image
from worlds import (
    CAMERAS,
    CHECKPOINT,
    DAY,
    FRAME,
    GRIDS,
    IMPROVED,
    LASER,
    PHOTOS,
    SCAN,
    WEIGHTS,
    ZIP,
    grid,
    photo,
    tar_of,
)

Damage = Callable[[bytes], bytes | None]
"""From the good file's bytes to the bad one's; None: it is removed."""


class Case(NamedTuple):
    """One input of a command."""

    world: str
    """What the command reads, of `worlds.py`."""
    file: str
    """Which of its files is another one."""
    what: str
    damage: Damage
    named: str | None = None
    """What the one line on stderr must hold beside "error:"; the file's name if nothing is given."""
    works: bool = False
    """Legal if unusual: the command must end well."""
    leaves: str = "nothing"
    """Begin of the names of files that may be there afterwards, since they are whole."""


def all_of(world: str, file: str, damages: dict[str, Damage], named: str | None = None) -> list[Case]:
    """Cases of one file."""
    return [Case(world, file, what, damage, named) for what, damage in damages.items()]


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


def image(mode: str, kind: str = "png", **settings) -> Damage:
    """The same picture in another mode or format."""

    def damage(whole: bytes) -> bytes:
        buffer = io.BytesIO()
        Image.open(io.BytesIO(whole)).convert(mode).save(buffer, kind, **settings)
        return buffer.getvalue()

    return damage


def deep(whole: bytes) -> bytes:
    """The same picture, grey, with 16 bits."""
    buffer = io.BytesIO()
    Image.fromarray(np.asarray(Image.open(io.BytesIO(whole)).convert("L")).astype(np.uint16) * 257).save(buffer, "png")
    return buffer.getvalue()


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
    buffer = io.BytesIO()
    Image.open(io.BytesIO(whole)).resize((100, 90)).save(buffer, "png")
    return buffer.getvalue()


def npz_of(**arrays: np.ndarray) -> Damage:
    """Another archive of arrays."""
    buffer = io.BytesIO()
    np.savez(buffer, **arrays)
    return text(buffer.getvalue())


def npz_bomb(whole: bytes) -> bytes:
    """Members that announce 4.2 GB each, in the archive's directory."""
    at = whole.index(b"PK\x01\x02")
    return whole[:at] + whole[at : at + 24] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 28 :]


class Evil:
    """Runs code where it is unpickled."""

    def __reduce__(self) -> tuple:
        return Path("pwned").touch, ()


def link(name: str) -> zipfile.ZipInfo:
    """A member that is a symbolic link."""
    info = zipfile.ZipInfo(name)
    info.external_attr = 0o120777 << 16
    return info


def swelling(_: bytes) -> bytes:
    """A zip of half a megabyte that unpacks to 500."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, archive.open("zeros.bin", "w") as member:
        for _ in range(500):
            member.write(bytes(10**6))
    return buffer.getvalue()


def special(kind: bytes) -> Damage:
    """A tar with one member that is no file."""
    info = tarfile.TarInfo("img-a.jpg")
    info.type, info.linkname = kind, "/etc/passwd"
    return lambda _: tar_of({"img-a.jpg": info})


def grids(content: bytes) -> Damage:
    """An archive of one laser grid."""
    return lambda _: tar_of({"depth_sph_corr-a.mat": content})


def of_unknown_type(whole: bytes) -> bytes:
    """A grid whose numbers are of a type that the format does not know."""
    tag = struct.pack("<II", 9, 55 * 305 * 4 * 8)
    assert tag in whole
    return whole.replace(tag, struct.pack("<II", 11, 55 * 305 * 4 * 8))


LINE = "2011_09_26/2011_09_26_drive_0001_sync 0000000001 l"
FRAMES = [
    *all_of("PNG frames", f"{FRAME}.png", NO_FILE | QUARTERS | {"truncated by a byte": lambda whole: whole[:-13], "a wrong checksum": turned(0.5)}),
    *all_of("PNG frames", f"{FRAME}.png", {"gigapixels": png_of_gigapixels, "another size": smaller}),
    *all_of("JPEG frames", f"{FRAME}.jpg", NO_FILE | QUARTERS | {"gigapixels": jpeg_of_gigapixels}),
    Case("PNG frames", f"{FRAME}.png", "grey", image("L"), works=True),
    Case("PNG frames", f"{FRAME}.png", "16 bits", deep, works=True),
    Case("PNG frames", f"{FRAME}.png", "palette", image("P"), works=True),
    Case("PNG frames", f"{FRAME}.png", "alpha", image("RGBA"), works=True),
    Case("JPEG frames", f"{FRAME}.jpg", "grey", image("L", "jpeg"), works=True),
    Case("JPEG frames", f"{FRAME}.jpg", "CMYK", image("CMYK", "jpeg"), works=True),
    Case("JPEG frames", f"{FRAME}.jpg", "progressive", image("RGB", "jpeg", progressive=True), works=True),
    *all_of("PNG frames", CAMERAS, {"missing": lambda _: None, "no P_rect_02": replaced("P_rect_02", "Q_rect_02")}),
]
SCANS = [
    *all_of("scans", SCAN, NO_FILE | QUARTERS | {"not finite": lambda whole: whole[:16] + struct.pack("<f", np.nan) + whole[20:]}),
    Case("scans", SCAN, "cut between points", lambda whole: whole[:1600], works=True),
    *all_of("scans", CAMERAS, NO_FILE | {"no R_rect_00": replaced("R_rect_00", "R_rect_01"), "11 numbers": replaced("P_rect_02: ", "P_rect_02: 1 ")}),
    *all_of("scans", CAMERAS, {"not finite": replaced("P_rect_02: 2.2", "P_rect_02: nan 2.2"), "words": replaced("P_rect_02: 2", "P_rect_02: wide")}),
    *all_of("scans", CAMERAS, {f"a size of {s}": replaced("S_rect_02: 80 40", f"S_rect_02: {s}") for s in ("-80 40", "1e9 1e9", "0 0", "80")}),
    *all_of("scans", LASER, NO_FILE | {"no T": replaced("T:", "X:"), "8 numbers": replaced("R: 0", "R:")}),
    *all_of("scans", "list.txt", NO_FILE | {"blank": text("\n \n"), "UTF-16": lambda whole: whole.decode().encode("utf-16")}),
    *all_of("scans", "list.txt", {"above the root": text(f"../{LINE}"), "no number": text(LINE.replace("0000000001", "one"))}),
    Case("scans", "list.txt", "a frame that is not there", replaced("0000000001", "0000000009"), "0000000009.bin"),
    Case("scans", "list.txt", "Windows line ends", lambda whole: whole.replace(b"\n", b"\r\n"), works=True),
    *all_of("scans", f"kitti/{DAY}/{DAY}_drive_0001_sync/image_02/data/0000000000.png", {"zero bytes": text(b""), "gigapixels": png_of_gigapixels}),
    *all_of("improved", IMPROVED, NO_FILE | QUARTERS | {"8 bits": image("L"), "colours": image("RGB"), "a wrong checksum": turned(0.7)}, "0000000001"),
]
POSES = [
    *all_of("odometry", "pred.txt", NO_FILE | QUARTERS),
    *all_of("odometry", "pred.txt", {"11 numbers": replaced("1 0 0 3 ", "1 0 3 "), "a word": replaced("3", "three"), "not finite": replaced("3", "nan")}),
    *all_of("odometry", "pred.txt", {"TUM": text("0 0 0 0 0 0 0 1\n" * 8), "no rotation": replaced("1 0 0 3", "2 0 0 3"), "a pose short": text("1 0 0 0 0 1 0 0 0 0 1 0\n")}),
]
ARRAYS = [
    *all_of("depth", "P.npy", QUARTERS | {"zip": text(b"PK\x03\x04" + bytes(40)), "header cut": lambda whole: whole[:8] + b"w" + whole[9:11] + whole[12:]}),
    *all_of("depth", "P.npy", {"a huge shape": replaced("(2, 10, 16)", "(2, 999999999, 16)"), "negative": replaced("(2, 10", "(2,-10")}),
    *all_of("depth", "G.npz", NO_FILE | QUARTERS | {"bomb": npz_bomb, "no members": text(zip_of({})), "no array": text(zip_of({"a.npy": b"no array"}))}),
    *all_of("depth", "G.npz", {"whole numbers": npz_of(a=np.ones((2, 3), int)), "pickled": npz_of(a=np.array([{}], object)), "a row": npz_of(a=np.ones(3))}),
    *all_of("depth", "w.json", NO_FILE | {"a list": text("[1]"), "deep": text("[" * 10**5), "drives are a number": text('{"drives": 5}')}, "w.json"),
    *all_of("depth", "w.json", {"no drives": text("{}")}, "w.safetensors"),
]
PROFILES = [
    *all_of("PNG frames", "own.yaml", NO_FILE | QUARTERS, "own"),
    *all_of("PNG frames", "own.yaml", {"unknown setting": replaced('"about"', '"abuot"'), "a list": text("- 1"), "Python": text("!!python/object/apply:os.getcwd []")}),
    *all_of("PNG frames", "own.yaml", {"a day that is none": text("about: 2001-99-99"), "type": replaced("[192, 192]", '"wide"'), "size": replaced("[192, 192]", "[100, 100]")}),
]
STORED = [
    *all_of("labels", "labels.png", NO_FILE | QUARTERS | {"colours": image("RGB"), "16 bits": deep, "JPEG": image("L", "jpeg")}),
    *all_of("PNG frames", CHECKPOINT, {"a web page": text("<html>"), "zero bytes": text(b""), "foreign": text(pickle.dumps({"a": 1})), "runs code": text(pickle.dumps(Evil()))}),
    *all_of("stage 2", WEIGHTS, {"zero bytes": text(b""), "changed": turned(0.8)} | QUARTERS),
    *all_of("stage 2", WEIGHTS.replace("safetensors", "json"), {"missing": lambda _: None, "a web page": text("<html>")}),
    Case("stage 2", WEIGHTS.replace("safetensors", "json"), "of another size", replaced("192", "288"), "model.safetensors"),
    *all_of("stage 2", "work/own/sources.json", {"a web page": text("<html>"), "a list": text("[]"), "cut": QUARTERS["truncated at 0.5"]}),
]
ARCHIVES = [
    *all_of("KITTI archive", ZIP, {k: v for k, v in NO_FILE.items() if k != "missing"} | QUARTERS | {"a wrong checksum": replaced("P_rect", "Q_rect")}, f"{DAY}_calib.zip"),
    *[
        Case("KITTI archive", ZIP, what, lambda _, name=name: zip_of({"good.txt": b"good", name: b"evil"}), f"{DAY}_calib.zip")
        for what, name in {"above": "../evil.txt", "absolute": "/tmp/evil.txt", "within": "a/../../evil.txt", "Windows": "..\\evil.txt", "link": link("evil")}.items()
    ],
    Case("KITTI archive", ZIP, "bomb", swelling, f"{DAY}_calib.zip"),
    Case("KITTI archive", ZIP, "name with spaces and umlauts", lambda _: zip_of({f"{DAY}/mit Wörtern 深.txt": b"good"}), works=True),
    *all_of("Make3D archive", PHOTOS, {k: v for k, v in NO_FILE.items() if k != "missing"} | QUARTERS | {"a wrong checksum": turned(0.6)}),
    *all_of("Make3D archive", PHOTOS, {"link": special(tarfile.SYMTYPE), "device": special(tarfile.CHRTYPE), "above": lambda _: tar_of({"../img-a.jpg": photo()})}),
    Case("Make3D archive", PHOTOS, "a quarter of a photo", lambda _: tar_of({"img-a.jpg": photo()[: len(photo()) // 4]}), "img-a.jpg"),
    Case("Make3D archive", PHOTOS, "no photo", lambda _: tar_of({"img-a.jpg": b"<html>"}), "img-a.jpg"),
    *[
        Case("Make3D archive", GRIDS, f"grid: {what}", grids(content), "depth_sph_corr-a.mat", leaves="make3d/Test134")
        for what, content in {
            **{name: cut(grid()) for name, cut in QUARTERS.items()},
            "a web page": b"<html>",
            "type": of_unknown_type(grid()),
            "compressed, changed": turned(0.5)(grid(do_compression=True)),
        }.items()
    ],
    Case("Make3D archive", GRIDS, "compressed grid", grids(grid(do_compression=True)), works=True),
]
CASES = [*FRAMES, *SCANS, *POSES, *ARRAYS, *PROFILES, *STORED, *ARCHIVES]
