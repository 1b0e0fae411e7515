"""The table of bad and of odd inputs: what is damaged, and how; or what is odd and works."""

import struct
from typing import NamedTuple

import numpy as np
from damages import (
    NO_FILE,
    QUARTERS,
    Damage,
    deep,
    grids,
    image,
    jpeg_of_gigapixels,
    npz_bomb,
    npz_of,
    png_of_gigapixels,
    replaced,
    smaller,
    swelling,
    text,
    turned,
)
from loopback import zip_of
from worlds import CAMERAS, DAY, FRAME, GRIDS, IMPROVED, LASER, PHOTOS, SCAN, WEIGHTS, ZIP, grid, photo, tar_of


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


LINE = "2011_09_26/2011_09_26_drive_0001_sync 0000000001 l"
FRAMES = [
    *all_of(
        "PNG frames",
        f"{FRAME}.png",
        NO_FILE | QUARTERS | {"truncated by a byte": lambda whole: whole[:-13], "a wrong checksum": turned(0.5)},
    ),
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
    *all_of(
        "scans",
        CAMERAS,
        NO_FILE
        | {"no R_rect_00": replaced("R_rect_00", "R_rect_01"), "11 numbers": replaced("P_rect_02: ", "P_rect_02: 1 ")}
        | {"not finite": replaced("P_rect_02: 2.2", "P_rect_02: nan 2.2"), "words": replaced("P_rect_02: 2", "P_rect_02: wide")}
        | {f"a size of {s}": replaced("S_rect_02: 80 40", f"S_rect_02: {s}") for s in ("-80 40", "1e9 1e9", "0 0", "80")},
    ),
    *all_of("scans", LASER, NO_FILE | {"no T": replaced("T:", "X:"), "8 numbers": replaced("R: 0", "R:")}),
    *all_of("scans", "list.txt", NO_FILE | {"blank": text("\n \n"), "UTF-16": lambda whole: whole.decode().encode("utf-16")}),
    *all_of("scans", "list.txt", {"above the root": text(f"../{LINE}"), "no number": text(LINE.replace("0000000001", "one"))}),
    Case("scans", "list.txt", "a frame that is not there", replaced("0000000001", "0000000009"), "0000000009.bin"),
    Case("scans", "list.txt", "Windows line ends", lambda whole: whole.replace(b"\n", b"\r\n"), works=True),
    *all_of(
        "scans",
        f"kitti/{DAY}/{DAY}_drive_0001_sync/image_02/data/0000000000.png",
        {"zero bytes": text(b""), "gigapixels": png_of_gigapixels},
    ),
    *all_of(
        "improved",
        IMPROVED,
        NO_FILE | QUARTERS | {"8 bits": image("L"), "colours": image("RGB"), "a wrong checksum": turned(0.7)},
        "0000000001",
    ),
]
POSES = all_of(
    "odometry",
    "pred.txt",
    NO_FILE
    | QUARTERS
    | {
        "11 numbers": replaced("1 0 0 3 ", "1 0 3 "),
        "a word": replaced("3", "three"),
        "not finite": replaced("3", "nan"),
        "TUM": text("0 0 0 0 0 0 0 1\n" * 8),
        "no rotation": replaced("1 0 0 3", "2 0 0 3"),
        "a pose short": text("1 0 0 0 0 1 0 0 0 0 1 0\n"),
    },
)
ARRAYS = [
    *all_of(
        "depth",
        "P.npy",
        QUARTERS | {"zip": text(b"PK\x03\x04" + bytes(40)), "header cut": lambda whole: whole[:8] + b"w" + whole[9:11] + whole[12:]},
    ),
    *all_of("depth", "P.npy", {"a huge shape": replaced("(2, 10, 16)", "(2, 999999999, 16)"), "negative": replaced("(2, 10", "(2,-10")}),
    *all_of(
        "depth",
        "G.npz",
        NO_FILE
        | QUARTERS
        | {"a wrong checksum": turned(0.25), "bomb": npz_bomb}
        | {"no members": text(zip_of({})), "no array": text(zip_of({"a.npy": b"no array"}))}
        | {"whole numbers": npz_of(a=np.ones((2, 3), int)), "pickled": npz_of(a=np.array([{}], object)), "a row": npz_of(a=np.ones(3))},
    ),
    *all_of(
        "depth",
        "w.json",
        NO_FILE | {"a list": text("[1]"), "deep": text("[" * 10**5), "drives are a number": text('{"drives": 5}')},
        "w.json",
    ),
    *all_of("depth", "w.json", {"no drives": text("{}")}, "w.safetensors"),
]
PROFILES = [
    *all_of("PNG frames", "own.yaml", NO_FILE | QUARTERS, "own"),
    *all_of(
        "PNG frames",
        "own.yaml",
        {"unknown setting": replaced('"about"', '"abuot"'), "a list": text("- 1"), "Python": text("!!python/object/apply:os.getcwd []")},
    ),
    *all_of("stage 2", "own.yaml", {"a variant above": replaced('"train"', '"variants": {"../x": {"label": "x", "about": "x"}}, "train"')}),
    *all_of(
        "PNG frames",
        "own.yaml",
        {
            "a day that is none": text("about: 2001-99-99"),
            "type": replaced("[192, 192]", '"wide"'),
            "size": replaced("[192, 192]", "[100, 100]"),
        },
    ),
]
STORED = [
    *all_of(
        "labels",
        "labels.png",
        NO_FILE | QUARTERS | {"a wrong checksum": turned(0.5), "colours": image("RGB"), "16 bits": deep, "JPEG": image("L", "jpeg")},
    ),
    *all_of("stage 2", WEIGHTS, {"zero bytes": text(b""), "changed": turned(0.8)}),
]
ARCHIVES = [
    *all_of(
        "KITTI archive",
        ZIP,
        {k: v for k, v in NO_FILE.items() if k != "missing"} | QUARTERS | {"a wrong checksum": replaced("P_rect", "Q_rect")},
        f"{DAY}_calib.zip",
    ),
    Case("KITTI archive", ZIP, "above", lambda _: zip_of({"good.txt": b"good", "../evil.txt": b"evil"}), f"{DAY}_calib.zip"),
    Case("KITTI archive", ZIP, "bomb", swelling, f"{DAY}_calib.zip"),
    Case("KITTI archive", ZIP, "name with spaces and umlauts", lambda _: zip_of({f"{DAY}/mit Wörtern 深.txt": b"good"}), works=True),
    *all_of("Make3D archive", PHOTOS, {k: v for k, v in NO_FILE.items() if k != "missing"} | QUARTERS | {"a wrong checksum": turned(0.6)}),
    Case("Make3D archive", PHOTOS, "above", lambda _: tar_of({"../img-a.jpg": photo()})),
    Case("Make3D archive", PHOTOS, "a quarter of a photo", lambda _: tar_of({"img-a.jpg": photo()[: len(photo()) // 4]}), "img-a.jpg"),
    Case("Make3D archive", PHOTOS, "no photo", lambda _: tar_of({"img-a.jpg": b"<html>"}), "img-a.jpg"),
    *[
        Case("Make3D archive", GRIDS, f"grid: {what}", grids(content), "depth_sph_corr-a.mat", leaves="make3d/Test134")
        for what, content in {
            **{name: cut(grid()) for name, cut in QUARTERS.items()},
            "a web page": b"<html>",
            "another variable": grid("Position2DGrid"),
            "another shape": grid(shape=(55, 300, 4)),
        }.items()
    ],
    Case("Make3D archive", GRIDS, "compressed grid", grids(grid(do_compression=True)), works=True),
]
CASES = [*FRAMES, *SCANS, *POSES, *ARRAYS, *PROFILES, *STORED, *ARCHIVES]
