"""The table of bad and of odd inputs: what is damaged, and how; or what is odd and works."""

import io
import struct
import zipfile
import zlib
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from loopback import tar_of, zip_of
from PIL import Image
from worlds import CAMERAS, DAY, DRIVE, FRAME, GRIDS, IMPROVED, LASER, PHOTOS, SCAN, WEIGHTS, ZIP, grid, photo, written

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
OTHER_FILE: dict[str, Damage] = {
    "zero bytes": text(b""),
    "a web page": text("<html>404 not found</html>"),
    "random bytes": text(np.random.default_rng(0).bytes(5000)),
}
MISSING: dict[str, Damage] = {"missing": lambda _: None}
NO_FILE = MISSING | OTHER_FILE


def redrawn(draw: Callable[[Image.Image], Image.Image]) -> Damage:
    """Another PNG made of the picture."""
    return lambda whole: written(draw(Image.open(io.BytesIO(whole))).save, "png")


def image(mode: str, kind: str = "png", **settings) -> Damage:
    """The same picture in another mode or format."""
    return lambda whole: written(Image.open(io.BytesIO(whole)).convert(mode).save, kind, **settings)


DEEP = redrawn(lambda picture: Image.fromarray(np.asarray(picture.convert("L")).astype(np.uint16) * 257))
"""16 bits of grey."""
RAW_IDS = redrawn(lambda picture: picture.point(lambda label: label + 18 * (label in (1, 2, 15))))
"""Some of Cityscapes' ids that are none of its training ids."""


def png_of_gigapixels(whole: bytes) -> bytes:
    """A header with a right checksum that announces 40,000 x 40,000 pixels."""
    size = whole[12:16] + struct.pack(">II", 40_000, 40_000) + whole[24:29]
    return whole[:12] + size + struct.pack(">I", zlib.crc32(size)) + whole[33:]


def jpeg_of_gigapixels(whole: bytes) -> bytes:
    """A frame header that announces 65,500 x 65,500 pixels."""
    at = whole.index(b"\xff\xc0") + 5
    return whole[:at] + struct.pack(">HH", 65_500, 65_500) + whole[at + 4 :]


def npz_of(array: np.ndarray) -> Damage:
    """Another archive, which holds this for both images."""
    return text(written(np.savez, array, array))


def npz_bomb(whole: bytes) -> bytes:
    """Members that announce 4.2 GB each, in the archive's directory."""
    at = whole.index(b"PK\x01\x02")
    return whole[:at] + whole[at : at + 24] + struct.pack("<I", 0xFFFFFFF0) + whole[at + 28 :]


def archive(member: str, content: bytes) -> Damage:
    """A tar of one file."""
    return text(tar_of({member: content}))


def swelling(_: bytes) -> bytes:
    """A zip of half a megabyte that unpacks to 500."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive, archive.open("zeros.bin", "w") as member:
        for _ in range(500):
            member.write(bytes(10**6))
    return buffer.getvalue()


class Case(NamedTuple):
    """One input of a command."""

    world: str
    """What the command reads, of `worlds.py`."""
    file: str
    """Which of its files is another one."""
    what: str
    damage: Damage
    named: str = ""
    """What the one line on stderr must hold beside "error:"; the file's name if nothing is given."""
    works: bool = False
    """Legal if unusual: the command must end well."""
    leaves: str = "nothing"
    """Begin of the names of files that may be there afterwards, since they are whole."""


def cases(world: str, file: str, damages: dict[str, Damage], **more: object) -> list[Case]:
    """All of one file."""
    return [Case(world, file, what, damage, **more) for what, damage in damages.items()]


LINE = f"{DRIVE} 0000000001 l"
PNG, JPEG, GRID = f"{FRAME}.png", f"{FRAME}.jpg", "depth_sph_corr-a.mat"
FRAMES = [
    *cases("PNG frames", PNG, NO_FILE | QUARTERS | {"truncated by a byte": lambda whole: whole[:-13], "a wrong checksum": turned(0.5)}),
    *cases("PNG frames", PNG, {"gigapixels": png_of_gigapixels, "another size": redrawn(lambda picture: picture.resize((100, 90)))}),
    *cases("PNG frames", PNG, {"grey": image("L"), "16 bits": DEEP, "palette": image("P"), "alpha": image("RGBA")}, works=True),
    *cases("JPEG frames", JPEG, NO_FILE | QUARTERS | {"gigapixels": jpeg_of_gigapixels}),
    *cases("JPEG frames", JPEG, {"grey": image("L", "jpeg"), "CMYK": image("CMYK", "jpeg")}, works=True),
    *cases("JPEG frames", JPEG, {"progressive": image("RGB", "jpeg", progressive=True)}, works=True),
]
SCANS = [
    *cases("scans", SCAN, NO_FILE | QUARTERS | {"not finite": lambda whole: whole[:16] + struct.pack("<f", np.nan) + whole[20:]}),
    *cases("scans", SCAN, {"cut between points": lambda whole: whole[:1600]}, works=True),
    *cases(
        "scans",
        CAMERAS,
        NO_FILE
        | {"no R_rect_00": replaced("R_rect_00", "R_rect_01"), "13 numbers": replaced("P_rect_02: ", "P_rect_02: 1 ")}
        | {"not finite": replaced("P_rect_02: 2.200000e+02", "P_rect_02: nan"), "words": replaced("P_rect_02: 2", "P_rect_02: wide")}
        | {f"a size of {s}": replaced("S_rect_02: 80 40", f"S_rect_02: {s}") for s in ("-80 40", "1e9 1e9", "0 0", "80")},
    ),
    *cases("scans", LASER, NO_FILE | {"no T": replaced("T:", "X:"), "8 numbers": replaced("R: 0", "R:")}),
    *cases("scans", "list.txt", NO_FILE | {"blank": text("\n \n"), "UTF-16": lambda whole: whole.decode().encode("utf-16")}),
    *cases("scans", "list.txt", {"above the root": text(f"../{LINE}"), "no number": text(LINE.replace("0000000001", "one"))}),
    *cases("scans", "list.txt", {"a frame that is not there": replaced("0000000001", "0000000009")}, named="0000000009.bin"),
    *cases("scans", "list.txt", {"Windows line ends": lambda whole: whole.replace(b"\n", b"\r\n")}, works=True),
    *cases("scans", f"kitti/{DRIVE}/image_02/data/0000000000.png", {"zero bytes": text(b""), "gigapixels": png_of_gigapixels}),
    *cases("improved", IMPROVED, NO_FILE | QUARTERS | {"8 bits": image("L"), "colours": image("RGB")}, named="0000000001"),
    *cases("improved", IMPROVED, {"a wrong checksum": turned(0.7)}, named="0000000001"),
]
POSES = [
    *cases("odometry", "pred.txt", NO_FILE | QUARTERS | {"11 numbers": replaced("1 0 0 3 ", "1 0 3 "), "a word": replaced("3", "three")}),
    *cases("odometry", "pred.txt", {"not finite": replaced("3", "nan"), "TUM": text("0 0 0 0 0 0 0 1\n" * 8)}),
    *cases("odometry", "pred.txt", {"no rotation": replaced("1 0 0 3", "2 0 0 3"), "a pose short": text("1 0 0 0 0 1 0 0 0 0 1 0\n")}),
]
ARRAYS = [
    *cases("depth", "P.npy", QUARTERS | {"zip": text(b"PK\x03\x04" + bytes(40))}),
    *cases("depth", "P.npy", {"header cut": lambda whole: whole[:8] + b"w" + whole[9:11] + whole[12:]}),
    *cases("depth", "P.npy", {"a huge shape": replaced("(2, 10, 16)", "(2, 999999999, 16)"), "negative": replaced("(2, 10", "(2,-10")}),
    *cases("depth", "G.npz", NO_FILE | QUARTERS | {"a wrong checksum": turned(0.25), "bomb": npz_bomb}),
    *cases("depth", "G.npz", {"no members": text(zip_of({})), "no array": text(zip_of(dict.fromkeys(("a.npy", "b.npy"), b"no array")))}),
    *cases("depth", "G.npz", {"cubes": npz_of(np.ones((2, 2, 2))), "whole numbers": npz_of(np.ones((2, 3), int))}),
    *cases("depth", "G.npz", {"pickled": npz_of(np.array([{}], object))}),
    *cases("depth", "w.json", NO_FILE | {"a list": text("[1]"), "deep": text("[" * 10**5), "drives are a number": text('{"drives": 5}')}),
    *cases("depth", "w.json", {"no drives": text("{}")}, named="w.safetensors"),
]
PROFILES = [
    *cases("PNG frames", "own.yaml", NO_FILE | QUARTERS, named="own"),
    *cases("PNG frames", "own.yaml", {"unknown setting": replaced('"about"', '"abuot"'), "a day that is none": text("about: 2001-99-99")}),
    *cases("PNG frames", "own.yaml", {"a list": text("- 1"), "Python": text("!!python/object/apply:os.getcwd []")}),
    *cases("PNG frames", "own.yaml", {"type": replaced("[192, 192]", '"wide"'), "size": replaced("[192, 192]", "[100, 100]")}),
    *cases("stage 2", "own.yaml", {"a variant above": replaced('"train"', '"variants": {"../x": {"label": "x", "about": "x"}}, "train"')}),
]
STORED = [
    *cases("labels", "labels.png", NO_FILE | QUARTERS | {"a wrong checksum": turned(0.5), "colours": image("RGB")}),
    *cases("labels", "labels.png", {"16 bits": DEEP, "JPEG": image("L", "jpeg"), "alpha": image("RGBA"), "black and white": image("1")}),
    *cases("labels", "labels.png", {"raw ids": RAW_IDS}, named="holds 19, 20, 33; give training ids 0 to 18"),
    *cases("stage 2", WEIGHTS, {"zero bytes": text(b""), "changed": turned(0.8)}),
]
WRONG_GRIDS = {name: cut(grid()) for name, cut in QUARTERS.items()} | {"a web page": b"<html>"}
WRONG_GRIDS |= {"another variable": grid("Position2DGrid"), "another shape": grid(shape=(55, 305, 3)), "words": grid(kind=str)}
ARCHIVES = [
    *cases("KITTI archive", ZIP, OTHER_FILE | QUARTERS | {"a wrong checksum": replaced("P_rect", "Q_rect"), "bomb": swelling}),
    *cases("KITTI archive", ZIP, {"above": text(zip_of({"good.txt": b"good", "../evil.txt": b"evil"}))}),
    *cases("KITTI archive", ZIP, {"name with spaces and umlauts": text(zip_of({f"{DAY}/mit Wörtern 深.txt": b"good"}))}, works=True),
    *cases("Make3D archive", PHOTOS, OTHER_FILE | QUARTERS | {"a wrong checksum": turned(0.6), "above": archive("../img-a.jpg", photo())}),
    *cases("Make3D archive", PHOTOS, {"a quarter of a photo": archive("img-a.jpg", photo()[: len(photo()) // 4])}, named="img-a.jpg"),
    *cases("Make3D archive", PHOTOS, {"no photo": archive("img-a.jpg", b"<html>")}, named="img-a.jpg"),
    *cases(
        "Make3D archive",
        GRIDS,
        {f"grid: {what}": archive(GRID, content) for what, content in WRONG_GRIDS.items()},
        named=GRID,
        leaves="make3d/Test134",
    ),
    *cases("Make3D archive", GRIDS, {"compressed grid": archive(GRID, grid(do_compression=True))}, works=True),
]
CASES = [*FRAMES, *SCANS, *POSES, *ARRAYS, *PROFILES, *STORED, *ARCHIVES]
