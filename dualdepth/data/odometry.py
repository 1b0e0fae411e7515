"""KITTI odometry on disk: sequences, their calibration and true poses, and the triplets to train on.

Layout, as KITTI unpacks: `ROOT/sequences/00/image_2/000000.png` (or .jpg), `ROOT/sequences/00/calib.txt`, `ROOT/poses/00.txt`.
"""

import csv
import os
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np

from dualdepth.atomic import atomic_path
from dualdepth.data.kitti import SUFFIXES, calibration_entry, numbered_lines, read_calibration
from dualdepth.data.triplets import Triplet
from dualdepth.errors import InputError

RAW_DRIVES = {
    "00": "2011_10_03/2011_10_03_drive_0027_sync",
    "01": "2011_10_03/2011_10_03_drive_0042_sync",
    "02": "2011_10_03/2011_10_03_drive_0034_sync",
    "03": "2011_09_26/2011_09_26_drive_0067_sync",
    "04": "2011_09_30/2011_09_30_drive_0016_sync",
    "05": "2011_09_30/2011_09_30_drive_0018_sync",
    "06": "2011_09_30/2011_09_30_drive_0020_sync",
    "07": "2011_09_30/2011_09_30_drive_0027_sync",
    "08": "2011_09_30/2011_09_30_drive_0028_sync",
    "09": "2011_09_30/2011_09_30_drive_0033_sync",
    "10": "2011_09_30/2011_09_30_drive_0034_sync",
}
"""The raw drive that each sequence was cut from (KITTI's odometry development kit)."""
CAMERA = "image_2"
"""The left colour camera, as in the paper."""


def check_odometry_root(root: str | Path) -> Path:
    """The odometry folder, checked to hold sequences.

    Raises:
        InputError: it is missing or holds no `sequences/NN`.
    """
    root = Path(root)
    if not any(root.glob("sequences/[0-9][0-9]")):
        raise InputError(f"ODOMETRY_ROOT {root}: holds no sequences/00, …; give the folder that holds `sequences` and `poses`")
    return root


def sequence_of(entry: str) -> tuple[str, str]:
    """(sequence, camera folder) of an entry like `00` or `06:image_0`."""
    name, _, camera = entry.partition(":")
    return name, camera or CAMERA


def frame_files(root: str | Path, entry: str) -> dict[int, Path]:
    """Image files of a sequence by frame number, in order.

    Raises:
        InputError: there are none; the message names the cameras that are there.
    """
    name, camera = sequence_of(entry)
    folder = Path(root) / "sequences" / name / camera
    files = [e.name for e in os.scandir(folder) if Path(e.name).suffix in SUFFIXES] if folder.is_dir() else []
    numbered = {int(Path(f).stem): folder / f for f in files if Path(f).stem.isdecimal()}
    if not numbered:
        there = sorted(p.name for p in folder.parent.glob("image_*") if p.is_dir())
        hint = f"; there is {' and '.join(there)}, say `{name}:{there[0]}`" if there else "; download the sequence first"
        raise InputError(f"{folder}: no images{hint}")
    return dict(sorted(numbered.items()))


def sequence_intrinsics(root: str | Path, entry: str) -> np.ndarray:
    """Intrinsics (3, 3) of a sequence's camera, in pixels of its frames.

    From `calib.txt` (`P2: …`), or from `calib_p0_p1.txt`, two rows without names, where that is all there is.

    Raises:
        InputError: no calibration, or none of that camera.
    """
    name, camera = sequence_of(entry)
    folder, number = Path(root) / "sequences" / name, camera.removeprefix("image_")
    path = folder / "calib.txt"
    bare = folder / "calib_p0_p1.txt"
    if not path.is_file() and bare.is_file():
        path = bare
        values = {f"P{line - 1}": _numbers(row) for line, row in numbered_lines(bare)}
    else:
        values = read_calibration(path)
    return calibration_entry(values, f"P{number}", 12, path).reshape(3, 4)[:, :3].copy()


def _numbers(row: str) -> np.ndarray:
    try:
        return np.array([float(x) for x in row.split()])
    except ValueError:
        return np.array([])


def poses_path(root: str | Path, entry: str) -> Path:
    """File of a sequence's true poses: `poses/NN.txt`, or `poses.txt` beside its images."""
    name, _ = sequence_of(entry)
    common = Path(root) / "poses" / f"{name}.txt"
    own = Path(root) / "sequences" / name / "poses.txt"
    return own if own.is_file() and not common.is_file() else common


def drives_of(sequences: Iterable[str], *, world: bool) -> list[str]:
    """The drives that sequences show, for the guard against leaks: raw drives, or of the synthetic world streets of their own."""
    names = [sequence_of(entry)[0] for entry in sequences]
    return sorted({f"odometry/{name}" if world else RAW_DRIVES.get(name, f"odometry/{name}") for name in names})


def guarded_drives(sequence: str) -> list[str]:
    """Drives that frames of a sequence are of, whether of KITTI or of the synthetic world: what a guard must look for.

    Raises:
        InputError: no sequence of KITTI's.
    """
    if sequence not in RAW_DRIVES:
        raise InputError(f"sequence {sequence!r}: give one of {', '.join(RAW_DRIVES)}")
    return [*drives_of([sequence], world=False), *drives_of([sequence], world=True)]


COLUMNS = ["sequence", "camera", "index", "previous", "target", "next", "fx", "fy", "cx", "cy"]


def write_odometry_index(path: str | Path, root: str | Path, sequences: Sequence[str]) -> int:
    """Write the triplets of some sequences as CSV, atomically: frame files and intrinsics; returns how many there are.

    Raises:
        InputError: a sequence has no images, no calibration or not three consecutive frames.
    """
    rows = []
    for entry in sequences:
        name, camera = sequence_of(entry)
        files, matrix = frame_files(root, entry), sequence_intrinsics(root, entry)
        lens = [f"{value:.9g}" for value in (matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2])]
        targets = [i for i in files if i - 1 in files and i + 1 in files]
        if not targets:
            raise InputError(f"{next(iter(files.values())).parent}: no three consecutive frames to train on")
        rows += [[name, camera, i, files[i - 1].name, files[i].name, files[i + 1].name, *lens] for i in targets]
    with atomic_path(path) as partial, partial.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([COLUMNS, *rows])
    return len(rows)


def load_odometry_triplets(path: str | Path, root: str | Path) -> tuple[list[Triplet], list[str]]:
    """What `write_odometry_index` wrote: triplets with full paths, and the sequences they are of.

    Raises:
        InputError: the file is missing or not such a CSV.
    """
    triplets, sequences = [], []
    try:
        with open(path, newline="", encoding="utf-8") as file:
            for row in csv.DictReader(file):
                folder = Path(root) / "sequences" / row["sequence"] / row["camera"]
                fx, fy, cx, cy = (float(row[k]) for k in ("fx", "fy", "cx", "cy"))
                paths = (folder / row["target"], folder / row["previous"], folder / row["next"])
                name = f"odometry/{row['sequence']}/{row['camera']}/{int(row['index']):06d}"
                triplets.append(Triplet(name, paths, np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])))
                sequences.append(row["sequence"])
    except (OSError, KeyError, TypeError, ValueError, csv.Error) as error:
        raise InputError(f"{path}: no list of prepared odometry triplets ({error!r}); run notebook 02_prepare_data") from None
    return triplets, sorted(set(sequences))
