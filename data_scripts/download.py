"""What the scripts that download data sets share: ask the sizes, check the disk, get and unpack each archive, mark it as done."""

import contextlib
import functools
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from data_scripts.archives import BadArchiveError, unpack
from data_scripts.fetch import fetch, gigabytes, part_size, remote_size, require_space
from data_scripts.sources import CAMERAS, Archive
from dualdepth.errors import InputError
from dualdepth.files import write_json

UNPACKED = 1.25
"""Unpacked size over archive size, estimated from above (images hardly shrink in an archive, laser scans do); checked exactly later."""
Check = Callable[[Archive, Path, Path], dict[str, Any]]
"""Looks at an archive, its file and the folder of what was in it; gives facts for the marker, or raises `BadArchiveError`."""


def progress(**settings: Any) -> tqdm:
    """A bar on stdout, since stderr is for the one line of an error; a log file gets fewer updates than a terminal."""
    return tqdm(file=sys.stdout, mininterval=0.5 if sys.stdout.isatty() else 5.0, dynamic_ncols=True, **settings)


def unpacked_cameras(archive: Archive, root: Path) -> set[str] | None:
    """Cameras that earlier runs unpacked of an archive, as its marker tells; None where there is no marker that can be read."""
    try:
        marker = json.loads((root / archive.marker).read_text(encoding="utf-8"))
        return set(marker["cameras"]) if marker["archive"] == archive.address else None
    except (OSError, ValueError, KeyError, TypeError):
        return None


def plan(archives: Sequence[Archive], root: Path, home: str, keep_archives: bool) -> tuple[int, int]:
    """Ask the sizes, say what is to come, check the disk; returns the bytes of all the archives, and how many of them are to come.

    Raises:
        InputError: an archive does not exist, no network, or the disk is too small.
    """
    asked = progress(iterable=archives, desc="asking for sizes", unit="archive", leave=False)
    sizes = [remote_size(home + archive.address) for archive in asked]
    left = [max(0, size - part_size(root / "archives" / archive.name)) for archive, size in zip(archives, sizes)]
    unpacked = UNPACKED * sum(sizes)
    # Archives that are deleted in turn never lie on the disk together.
    needed = unpacked + (sum(left) if keep_archives else max(left))
    coming = f"{gigabytes(sum(left))} of {gigabytes(sum(sizes))} to download"
    print(f"{len(archives)} archives: {coming}, at most {gigabytes(unpacked)} when unpacked", flush=True)
    require_space(root, needed, "the download")
    return sum(sizes), sum(left)


def download(
    archives: Sequence[Archive],
    root: Path,
    home: str,
    *,
    cameras: Sequence[str] = CAMERAS,
    check: Check = lambda *_: {},
    keep_archives: bool = False,
) -> int:
    """Download and unpack into `root` what is not there yet, and return the number of archives that were missing.

    An archive's marker is written last; a bad archive is deleted, so that the next run gets it anew.

    Args:
        archives, root, home: all that is wanted, the folder to fill, and the address that theirs are relative to.
        cameras, check: what to unpack, and how to look at what came.
        keep_archives: in `root/archives`; else each goes once unpacked.

    Raises:
        InputError: no network, no such archive, a damaged one, or a disk that is too small.
    """
    before = {archive: unpacked_cameras(archive, root) for archive in archives}
    pending = [archive for archive, there in before.items() if there is None or (archive.images and not set(cameras) <= there)]
    if not pending:
        return 0
    total, left = plan(pending, root, home, keep_archives)
    with progress(total=total, initial=total - left, unit="B", unit_scale=True) as bar:
        for number, archive in enumerate(pending, 1):
            bar.set_description(f"{number}/{len(pending)} {archive.name}")
            path = root / "archives" / archive.name
            fetch(home + archive.address, path, digest=archive.digest, bar=bar)
            place, look = functools.partial(archive.place, cameras=cameras), functools.partial(check, archive, path)
            try:
                with progress(desc=f"unpacking {archive.name}", unit="B", unit_scale=True, leave=False, position=1) as unpacking:
                    facts = unpack(path, root / archive.folder, place, unpacking, check=look)
            except BadArchiveError as error:
                path.unlink()
                raise InputError(f"{error}; the archive is deleted, run again to get it anew") from None
            there = sorted((before[archive] or set()) | set(cameras)) if archive.images else []
            write_json(root / archive.marker, {"archive": archive.address, "cameras": there} | facts)
            if not keep_archives:
                path.unlink()
    with contextlib.suppress(OSError):  # not empty: archives that were to be kept
        (root / "archives").rmdir()
    return len(pending)
