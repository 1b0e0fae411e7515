"""Where KITTI, Make3D and the field's lists live in public: nothing else is ever downloaded.

KITTI: A. Geiger, P. Lenz, C. Stiller, R. Urtasun, "Vision meets Robotics: The KITTI Dataset", IJRR 2013 (CC BY-NC-SA 3.0).
Improved depth: J. Uhrig et al., "Sparsity Invariant CNNs", 3DV 2017.
Make3D: A. Saxena, M. Sun, A. Y. Ng, "Make3D: Learning 3D Scene Structure from a Single Still Image", IEEE PAMI 2009
(make3d.cs.cornell.edu/data.html).
"""

import fnmatch
import itertools
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import NamedTuple

from data_scripts.fetch import fetch
from dualdepth.data.kitti import read_frame_list
from dualdepth.errors import InputError
from dualdepth.files import write_text
from dualdepth.settings import Data

KITTI_HOME = "https://s3.eu-central-1.amazonaws.com/avg-kitti/"
MAKE3D_HOME = "https://www.cs.cornell.edu/~asaxena/learningdepth/"
LISTS_HOME = "https://raw.githubusercontent.com/"
CAMERAS = ("image_00", "image_01", "image_02", "image_03")
DATES = ("2011_09_26", "2011_09_28", "2011_09_29", "2011_09_30", "2011_10_03")

SPLITS = "nianticlabs/monodepth2/b676244e5a1ca55564eb5d16ab521a48f823af31/splits"
SFMLEARNER = "tinghuiz/SfMLearner/2a387b763bc2b6f95b095f929bf751797c9db68a/data/kitti"


class Entry(NamedTuple):
    """A list that the field's papers share: its path below `LISTS_HOME`, and the sha256 of its bytes."""

    path: str
    sha256: str


LISTS = {
    "eigen_test": Entry(f"{SPLITS}/eigen/test_files.txt", "e226d4ca16e0e6e9695435014347dcf973588531330536fd8a68d298ef091a6b"),
    "eigen_zhou_train": Entry(f"{SPLITS}/eigen_zhou/train_files.txt", "00173a231642151c4693274e701ddd4cae7916520a757c7a94eae8e1173f7b0c"),
    "eigen_zhou_val": Entry(f"{SPLITS}/eigen_zhou/val_files.txt", "64a868b8d2c66c3979a2d74c22ea2e9146850d5b9f5786ed8e5f92201ba1ad04"),
    "eigen_improved": Entry(f"{SPLITS}/eigen_benchmark/test_files.txt", "d56e5e509e6960a01fb93795f85028ac6e4a82ad40e64b6e968988e4db95b9be"),
    "static_frames": Entry(f"{SFMLEARNER}/static_frames.txt", "268ef2acb91035acca2db9631d23af5a4c1a9a95af31c9099a000fba82c88e11"),
    "test_scenes": Entry(f"{SFMLEARNER}/test_scenes_eigen.txt", "df2563d0d3482ab6da413cdc4471b04938970a5317f6bd843b9280a81d437981"),
}
DERIVED = {"sample_test": ("eigen_test", ("2011_09_26_drive_0052_sync", "2011_09_26_drive_0013_sync"))}
"""Lists that are the lines of another one from some drives: `sample` scores the Eigen frames of the two smallest suitable drives."""


def named_list(name: str, cache_dir: str | Path, home: str = LISTS_HOME) -> Path:
    """Local path of a field's list, downloaded once; a copy that is there already is verified too.

    Args:
        name, cache_dir: a key of `LISTS` or `DERIVED`, and the folder that holds, or will hold, `<name>.txt`; or the path of a file.
        home: another server in place of the public one (tests).

    Raises:
        InputError: no such list, no network, or bytes whose sha256 differs.
    """
    path = Path(cache_dir) / f"{name}.txt"
    if name in LISTS:
        return fetch(home + LISTS[name].path, path, digest=f"sha256:{LISTS[name].sha256}")
    if name in DERIVED:
        origin, drives = DERIVED[name]
        lines = named_list(origin, cache_dir, home).read_text(encoding="utf-8").splitlines(keepends=True)
        write_text(path, "".join(line for line in lines if any(drive in line for drive in drives)))
        return path
    if Path(name).is_file():
        return Path(name)
    raise InputError(f"list {name!r} is not known; choose one of {', '.join([*LISTS, *DERIVED])} or give the path of a file")


def profile_lists(data: Data, cache_dir: str | Path, home: str = LISTS_HOME) -> dict[str, Path]:
    """Local paths of the lists that a profile names: `test_list`, `train_list`, `static_frames`, `test_scenes`; see `named_list`."""
    named = data.model_dump(include={"test_list", "static_frames", "test_scenes"})
    named["train_list"] = data.train_list and f"{data.train_list}_train"
    return {key: named_list(name, cache_dir, home).resolve() for key, name in named.items() if name}


def profile_drives(data: Data, lists: Mapping[str, Path]) -> list[str]:
    """The raw drives that a profile trains and is scored on: its own, and those of its lists; the others only take frames away."""
    frames = [frame for key in ("test_list", "train_list") if key in lists for frame in read_frame_list(lists[key])]
    return sorted({drive.partition(":")[0] for drive in data.train_drives} | {frame.drive for frame in frames})


class Archive(NamedTuple):
    """A zip of KITTI's, or a gzipped tar of Make3D's."""

    address: str  # relative to the data set's home
    marker: str  # file below the root that is written last, and says that the archive is unpacked
    folder: str = ""  # folder below the root to unpack in
    strip: str = ""  # leading folder of the members that is dropped
    pattern: str = ""  # of the file names that alone are kept, whatever folders the archive nests them in
    images: bool = False  # whether it holds cameras that can be chosen from
    digest: str | None = None  # `method:hex`, where one is published

    @property
    def name(self) -> str:
        """File name."""
        return self.address.rsplit("/", 1)[-1]

    def place(self, member: str, cameras: Sequence[str]) -> str | None:
        """Path below `folder` of a member, or None for what is not wanted (odometry's camera `image_2` is raw's `image_02`)."""
        if self.pattern:
            name = member.rsplit("/", 1)[-1]
            return name if fnmatch.fnmatchcase(name, self.pattern) else None
        camera = re.search(r"(?:^|/)image_0?([0-3])/", member)
        if camera and f"image_0{camera[1]}" not in cameras:
            return None
        return member.removeprefix(self.strip)


ODOMETRY = tuple(
    Archive(f"data_odometry_{part}.zip", f"odometry/.data_odometry_{part}.complete.json", "odometry", "dataset/", images=part == "color")
    for part in ("poses", "calib", "color")
)
IMPROVED_DEPTH = Archive(
    "data_depth_annotated.zip",
    "depth_annotated/.data_depth_annotated.complete.json",
    "depth_annotated",
    images=True,
    digest="md5:7d1ce32633dc2f43d9d1656a1f875e47",
)
MAKE3D = (  # no checksum of them is published
    Archive("Test134.tar.gz", "Test134/.complete.json", "Test134", pattern="img-*.jpg"),
    Archive("Test134Depth.tar.gz", "Gridlaserdata/.complete.json", "Gridlaserdata", pattern="depth_sph_corr-*.mat"),
)


def drive_archives(drives: Sequence[str]) -> list[Archive]:
    """Archives of raw drives, each day's calibration first.

    Args:
        drives: names like `2011_09_26/2011_09_26_drive_0095_sync`; the day in front and `_sync` may be left out.

    Raises:
        InputError: a name that is none of KITTI's.
    """
    names = set()
    for drive in drives:
        match = re.fullmatch(r"(?:(\d{4}_\d\d_\d\d)/)?((\d{4}_\d\d_\d\d)_drive_\d{4})(?:_sync)?", drive.strip("/"))
        if not match or match[3] not in DATES or match[1] not in (None, match[3]):
            raise InputError(f"drive {drive!r}: expected a name like 2011_09_26/2011_09_26_drive_0095_sync, of {', '.join(DATES)}")
        names.add(match[2])
    archives = []
    for date, of_day in itertools.groupby(sorted(names), key=lambda name: name[:10]):
        archives.append(Archive(f"raw_data/{date}_calib.zip", f"{date}/.calib.complete.json"))
        archives += [Archive(f"raw_data/{name}/{name}_sync.zip", f"{date}/{name}_sync/.complete.json", images=True) for name in of_day]
    return archives
