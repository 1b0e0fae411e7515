"""Download KITTI, as much of it as is needed, from its public home.

    python data_scripts/download_kitti.py --root KITTI --profile sample

Resumes where it was stopped, verifies all it gets, and does nothing for what is there already.
Whoever has KITTI needs none of this: give that folder as KITTI_ROOT.
"""

import argparse
import contextlib
import json
import os
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from data_scripts.archives import BadArchiveError, unpack
from data_scripts.fetch import fetch, gigabytes, part_size, remote_size, require_space
from data_scripts.sources import (
    CAMERAS,
    IMPROVED_DEPTH,
    KITTI_HOME,
    LISTS,
    LISTS_HOME,
    ODOMETRY,
    Archive,
    drive_archives,
    named_list,
    profile_drives,
)
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import write_json
from dualdepth.profile import load_profile

UNPACKED = 1.25
"""Unpacked size over archive size, estimated from above (images hardly shrink in a zip, laser scans do); checked exactly later."""

EXAMPLES = """\
examples:
  --root KITTI --profile sample                    the three drives of the profile `sample` (2 GB)
  --root KITTI --profile paper --cameras image_02 image_03
                                                   all that the paper's split needs (some 170 GB), colour cameras only
  --root KITTI 2011_09_26/2011_09_26_drive_0095_sync
                                                   one drive, with the calibration of its day
  --root KITTI --odometry                          colour images (65 GB), calibration and poses, in KITTI/odometry
  --root KITTI --improved-depth                    accumulated depth maps (14 GB), in KITTI/depth_annotated
  --root KITTI --lists-only                        the field's lists of frames (2 MB), in KITTI/lists

Stop it at any time: the same command goes on from there. The data are for non-commercial use (CC BY-NC-SA 3.0), see cvlibs.net.
"""


def progress(**settings: Any) -> tqdm:
    """A bar on stdout, since stderr is for the one line of an error; a log file gets fewer updates than a terminal."""
    return tqdm(file=sys.stdout, mininterval=0.5 if sys.stdout.isatty() else 5.0, dynamic_ncols=True, **settings)


def unpacked_cameras(archive: Archive, root: Path) -> set[str] | None:
    """Cameras that earlier runs unpacked of an archive, as its marker tells; None where there is no marker that can be read."""
    try:
        return set(json.loads((root / archive.marker).read_text(encoding="utf-8"))["cameras"])
    except (OSError, ValueError, KeyError, TypeError):
        return None


def is_complete(archive: Archive, root: Path, cameras: Sequence[str]) -> bool:
    """Whether the wanted cameras of an archive were unpacked before; asks only the disk."""
    there = unpacked_cameras(archive, root)
    return there is not None and (not archive.images or set(cameras) <= there)


def plan(archives: list[Archive], root: Path, *, kitti_home: str, keep_archives: bool) -> int:
    """Ask the sizes, say what is to come, check the disk.

    Returns:
        The bytes of all the archives.

    Raises:
        InputError: an archive does not exist, no network, or the disk is too small.
    """
    sizes = {}
    for archive in progress(iterable=archives, desc="asking for sizes", unit="archive", leave=False):
        sizes[archive.name] = remote_size(kitti_home + archive.address)
    left = {name: max(0, size - part_size(root / "archives" / name)) for name, size in sizes.items()}
    total, missing = sum(sizes.values()), sum(left.values())
    unpacked = UNPACKED * total
    # Archives that are deleted in turn never lie on the disk together.
    needed = unpacked + (missing if keep_archives else max(left.values()))
    here = f" ({gigabytes(total - missing)} of {gigabytes(total)} are here already)" if missing < total else ""
    print(f"{len(archives)} archives: {gigabytes(missing)} to download{here}, at most {gigabytes(unpacked)} when unpacked", flush=True)
    require_space(root, needed, "the download")
    print(f"the disk of {root} has the {gigabytes(needed)} that this takes", flush=True)
    return total


def install(archive: Archive, root: Path, cameras: Sequence[str], *, kitti_home: str, keep_archives: bool, bar: tqdm) -> None:
    """Download and unpack one archive and write its marker last; a bad archive is deleted, so that the next run gets it anew."""
    path = root / "archives" / archive.name
    fetch(kitti_home + archive.address, path, digest=archive.digest, bar=bar)
    try:
        with progress(desc=f"unpacking {archive.name}", unit="B", unit_scale=True, leave=False, position=1) as unpacking:
            unpacked = unpack(path, root / archive.folder, lambda member: archive.place(member, cameras), unpacking)
    except BadArchiveError as error:
        path.unlink()
        raise InputError(f"{error}; the archive is deleted, run again to get it anew") from None
    there = sorted((unpacked_cameras(archive, root) or set()) | set(cameras))
    write_json(root / archive.marker, {"archive": archive.address, "cameras": there, "files": unpacked.files, "bytes": unpacked.size})
    if not keep_archives:
        path.unlink()


def download(
    archives: list[Archive], root: Path, *, cameras: Sequence[str] = CAMERAS, keep_archives: bool = False, kitti_home: str = KITTI_HOME
) -> int:
    """Download and unpack what is not there yet, and return the number of archives that were missing.

    Raises:
        InputError: no network, no such archive, a damaged one, or a disk that is too small.
    """
    pending = [archive for archive in archives if not is_complete(archive, root, cameras)]
    if not pending:
        return 0
    total = plan(pending, root, kitti_home=kitti_home, keep_archives=keep_archives)
    begun = sum(part_size(root / "archives" / archive.name) for archive in pending)
    with progress(total=total, initial=begun, unit="B", unit_scale=True) as bar:
        for number, archive in enumerate(pending, 1):
            bar.set_description(f"{number}/{len(pending)} {archive.name}")
            install(archive, root, cameras, kitti_home=kitti_home, keep_archives=keep_archives, bar=bar)
    with contextlib.suppress(OSError):  # not empty: archives that were to be kept
        (root / "archives").rmdir()
    return len(pending)


def arguments_of(argv: Sequence[str] | None) -> argparse.Namespace:
    """Parse the command line."""
    parser = argparse.ArgumentParser(
        description="Download KITTI from its public home: resumable, verified, and only what is not there yet.",
        epilog=EXAMPLES,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    parser.add_argument("drives", nargs="*", metavar="DRIVE", help="raw drives like 2011_09_26/2011_09_26_drive_0095_sync")
    parser.add_argument("--root", required=True, type=Path, metavar="DIR", help="folder to fill, then given as KITTI_ROOT")
    parser.add_argument("--profile", metavar="NAME", help="the raw drives and lists that a profile needs: sample, paper, or a .yaml file")
    parser.add_argument("--odometry", action="store_true", help="the odometry sequences: colour images, calibration, poses (65 GB)")
    parser.add_argument("--improved-depth", action="store_true", help="the improved ground truth, data_depth_annotated (14 GB)")
    parser.add_argument("--lists-only", action="store_true", help="the field's lists of frames and nothing else")
    parser.add_argument(
        "--cameras", nargs="+", choices=CAMERAS, default=CAMERAS, metavar="CAMERA", help="unpack only these, such as image_02 image_03"
    )
    parser.add_argument("--keep-archives", action="store_true", help="keep the zip files, in DIR/archives; else each goes once unpacked")
    arguments = parser.parse_args(argv)
    if not (arguments.drives or arguments.profile or arguments.odometry or arguments.improved_depth or arguments.lists_only):
        parser.error("nothing to download: name drives, or give --profile, --odometry, --improved-depth or --lists-only")
    return arguments


def main(argv: Sequence[str] | None = None, *, kitti_home: str = KITTI_HOME, lists_home: str = LISTS_HOME) -> int:
    """Run the command line; 0 when everything is there. Other homes than the public ones are for tests.

    Raises:
        SystemExit: code 2, after one line on stderr, for bad input, a failed download, a full disk.
    """
    arguments = arguments_of(argv)
    root, lists = arguments.root, arguments.root / "lists"
    with exit_on_input_error():
        drives = list(arguments.drives)
        drive_archives(drives)  # a misspelt name is told before anything is fetched
        profile = load_profile(arguments.profile) if arguments.profile else None
        check_writable(root)
        if profile:
            drives += profile_drives(profile, lists, lists_home)
        if profile or arguments.lists_only:
            for name in LISTS:
                named_list(name, lists, lists_home)
            print(f"{len(LISTS)} lists in {lists}")
        if arguments.lists_only:
            return 0
        archives = drive_archives(drives) + (list(ODOMETRY) if arguments.odometry else [])
        archives += [IMPROVED_DEPTH] if arguments.improved_depth else []
        fetched = download(archives, root, cameras=arguments.cameras, keep_archives=arguments.keep_archives, kitti_home=kitti_home)
        print(f"{len(archives)} archives unpacked, {fetched} of them now")
        if drives:
            print(f"KITTI_ROOT={root}")
        if arguments.odometry:
            print(f"ODOMETRY_ROOT={root / 'odometry'}")
        if arguments.improved_depth:
            print(f"improved ground truth: {root / 'depth_annotated'}")
    return 0


def check_writable(root: Path) -> None:
    """Check that the folder to fill can be made and written, without making it."""
    existing = next(folder for folder in (root.absolute(), *root.absolute().parents) if folder.exists())
    if not existing.is_dir() or not os.access(existing, os.W_OK):
        raise InputError(f"{root}: {existing} is not a folder that can be written; give --root a folder of your own")


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print("stopped; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
