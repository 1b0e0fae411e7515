"""Training triplets: a target frame and its two neighbours in time (Zhou et al.: static frames and test drives left out)."""

import csv
import functools
import os
from collections.abc import Collection, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd

from dualdepth.data.kitti import SUFFIXES, Frame, intrinsics
from dualdepth.errors import InputError, reading
from dualdepth.files import write_text


class Triplet(NamedTuple):
    """Files of the target, previous and next frame, the intrinsics (3, 3) in pixels of the raw frame, and the drive or sequence."""

    name: str
    paths: tuple[Path, Path, Path]
    intrinsics: np.ndarray
    drive: str = ""


def drive_triplets(
    root: str | Path,
    drives: Iterable[str],
    cameras: Sequence[str] = ("image_02",),
    static: Collection[tuple[str, int]] = (),
    test_scenes: Collection[str] = (),
) -> list[Frame]:
    """Targets whose neighbours in number, of the same drive and camera below the KITTI raw folder `root`, are there and not static.

    `drives` are `date/date_drive_XXXX_sync`, with `:image_00` behind it to read that camera; for the others `cameras` are folders in order
    of preference, of which the first that a drive has is read. `static` are (drive, index) of frames where the camera stands still. A drive
    of `test_scenes`, which hold test frames, is an `InputError`, as are drives without frames (all are named) and no triplet at all.
    """
    chosen = [entry.partition(":")[::2] for entry in drives]
    leaked = sorted({drive for drive, _ in chosen} & set(test_scenes))
    if leaked:
        raise InputError(f"training drives {', '.join(leaked)} hold test frames: take them out of train_drives")
    targets, empty = [], []
    for drive, asked in chosen:
        there = {name: _numbers(Path(root) / drive / name / "data") for name in ([asked] if asked else cameras)}
        camera, indices = next(((name, numbers) for name, numbers in there.items() if numbers), ("", set()))
        if not indices:
            empty.append(f"{drive}/{asked or ' or '.join(cameras)}")
        moving = indices - {i for d, i in static if d == drive}
        targets += [Frame(drive, i, camera) for i in sorted(moving) if {i - 1, i + 1} <= moving]
    if empty:
        raise InputError(f"{root}: no frames in {', '.join(empty)}; download these drives first")
    if not targets:
        raise InputError(f"{root}: no three consecutive moving frames in {', '.join(d for d, _ in chosen)}; training needs a triplet")
    return targets


def _numbers(folder: Path) -> set[int]:
    """Of the image files in a folder, named by ten digits."""
    names = map(os.path.splitext, os.listdir(folder) if folder.is_dir() else [])
    return {int(stem) for stem, suffix in names if suffix in SUFFIXES and len(stem) == 10 and stem.isdecimal()}


def missing_neighbours(root: str | Path, targets: Iterable[Frame]) -> list[Frame]:
    """Frames of the targets' triplets that have no image file; each folder is listed once."""
    have = functools.cache(lambda drive, camera: _numbers(Path(root) / drive / camera / "data"))
    frames = {target._replace(index=target.index + offset) for target in targets for offset in (-1, 0, 1)}
    return sorted(frame for frame in frames if frame.index not in have(frame.drive, frame.camera))


def missing_files_error(what: str, root: str | Path, missing: Iterable[tuple[Frame, str]]) -> InputError:
    """One message for all files that are `missing` below `root`, `what` says for what: frames and the folder, such as `image_02`, of each;
    neighbours in number are written as ranges."""
    folders: dict[str, set[int]] = {}
    for frame, folder in missing:
        folders.setdefault(f"{frame.drive}/{folder}/data", set()).add(frame.index)
    listed = []
    for folder, gone in sorted(folders.items()):
        ranges = zip(sorted(i for i in gone if i - 1 not in gone), sorted(i for i in gone if i + 1 not in gone))
        listed.append(f"{folder} " + ", ".join(f"{a:010d}" if a == b else f"{a:010d}-{b:010d}" for a, b in ranges))
    count = sum(map(len, folders.values()))
    return InputError(f"{root}: {count} files {what} are missing: {'; '.join(listed)}; get them with data_scripts/download_kitti.py")


def raw_triplets(root: str | Path, targets: Iterable[Frame]) -> list[Triplet]:
    """Triplets of targets, in their order; each folder is listed once, and may hold PNG and JPEG. An `InputError` names a calibration
    that is missing or cannot be read."""
    matrix = functools.cache(functools.partial(intrinsics, root))
    there = functools.cache(lambda folder: {*os.listdir(folder)} if folder.is_dir() else set())
    found = []
    for frame in targets:
        folder = Path(root) / frame.drive / frame.camera / "data"
        names = [[f"{frame.index + offset:010d}{suffix}" for suffix in SUFFIXES] for offset in (0, -1, 1)]
        target, previous, following = (folder / next((name for name in some if name in there(folder)), some[0]) for some in names)
        found.append(Triplet(str(frame), (target, previous, following), matrix(frame.date, frame.camera), frame.drive))
    return found


def write_triplets(path: str | Path, root: str | Path, triplets: Iterable[Triplet]) -> None:
    """Write triplets of files below `root` as CSV, atomically."""
    rows = [
        (t.drive, t.name, *(file.relative_to(root).as_posix() for file in t.paths), *t.intrinsics[[0, 1, 0, 1], [0, 1, 2, 2]])
        for t in triplets
    ]
    columns = ["drive", "name", "target", "previous", "next", "fx", "fy", "cx", "cy"]
    write_text(path, pd.DataFrame(rows, columns=columns).to_csv(index=False))


def load_triplets(path: str | Path, root: str | Path) -> list[Triplet]:
    """What `write_triplets` wrote, in its order, with full paths; an `InputError` if the file is missing or not such a CSV."""
    found = []
    with reading(path, "run notebook 02_prepare_data"), open(path, newline="", encoding="utf-8") as file:
        for row in csv.DictReader(file):
            target, previous, following = (Path(root) / row[name] for name in ("target", "previous", "next"))
            fx, fy, cx, cy = (float(row[name]) for name in ("fx", "fy", "cx", "cy"))
            matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])
            found.append(Triplet(row["name"], (target, previous, following), matrix, row["drive"]))
    return found
