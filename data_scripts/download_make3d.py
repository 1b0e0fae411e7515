"""Download Make3D's test set from its public home: 134 photos and their laser grids, some 210 MB.

    python data_scripts/download_make3d.py --root MAKE3D

Resumes where it was stopped and does nothing for what is there already. No checksum of the two archives is published: their announced size,
the CRC inside them and their content are verified (134 photos that can be decoded, 134 grids of the right shape, each of one name), and
the sha256 of what came stands in `Test134/.complete.json` and `Gridlaserdata/.complete.json`.
Whoever has Make3D needs none of this: give the folder that holds Test134 and Gridlaserdata as MAKE3D_ROOT.
"""

import argparse
import contextlib
import json
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tqdm import tqdm

from data_scripts.archives import BadArchiveError, unpack_tar
from data_scripts.download_kitti import check_writable, progress
from data_scripts.fetch import fetch, gigabytes, part_size, remote_size, require_space
from data_scripts.sources import MAKE3D, MAKE3D_HOME, PhotoArchive
from dualdepth.data.make3d import MAKE3D_PHOTOS, find_pairs, is_truncated, read_grid, read_photo
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import file_digest, write_json

UNPACKED = 1.25
"""Unpacked size over archive size, estimated from above (photos hardly shrink); checked exactly later."""
IF_OFFLINE = "if you have Make3D, give MAKE3D_ROOT"


def is_complete(archive: PhotoArchive, root: Path) -> bool:
    """Whether an archive was unpacked and found whole before; asks only the disk."""
    try:
        return json.loads((root / archive.marker).read_text(encoding="utf-8"))["archive"] == archive.name
    except (OSError, ValueError, KeyError, TypeError):
        return False


def plan(archives: Sequence[PhotoArchive], root: Path, home: str) -> int:
    """Ask the sizes, say what is to come, check the disk; returns the bytes of all the archives.

    Raises:
        InputError: an archive does not exist, no network, or the disk is too small.
    """
    sizes = {archive.name: remote_size(home + archive.name, IF_OFFLINE) for archive in archives}
    total = sum(sizes.values())
    missing = sum(max(0, size - part_size(root / "archives" / name)) for name, size in sizes.items())
    here = f" ({gigabytes(total - missing)} of {gigabytes(total)} are here already)" if missing < total else ""
    print(
        f"{len(archives)} archives: {gigabytes(missing)} to download{here}, at most {gigabytes(UNPACKED * total)} when unpacked", flush=True
    )
    require_space(root, UNPACKED * total + missing, "the download")
    return total


def check_content(archive: PhotoArchive, root: Path) -> dict[str, Any]:
    """Read every file that an archive brought, as the evaluation will.

    Returns:
        For the marker: `files`, and `truncated`, the names of photos that lack their end.

    Raises:
        BadArchiveError: there are not 134 of them, or one cannot be read.
    """
    files = sorted((root / archive.folder).glob(archive.members))
    if len(files) != MAKE3D_PHOTOS:
        raise BadArchiveError(f"{root / archive.folder}: holds {len(files)} files {archive.members}, expected {MAKE3D_PHOTOS}")
    truncated = []
    for path in progress(iterable=files, desc=f"checking {archive.folder}", unit="file", leave=False):
        try:
            if path.suffix == ".mat":
                read_grid(path)
            else:
                read_photo(path)
                truncated += [path.name] * is_truncated(path)
        except InputError as error:
            raise BadArchiveError(str(error)) from None
    return {"files": len(files), "truncated": truncated}


def install(archive: PhotoArchive, root: Path, *, home: str, keep_archives: bool, bar: tqdm) -> None:
    """Download, unpack and check one archive and write its marker last; a bad archive is deleted, so that the next run gets it anew."""
    path, staging = root / "archives" / archive.name, root / "archives" / "unpacked"
    fetch(home + archive.name, path, bar=bar, if_offline=IF_OFFLINE)
    shutil.rmtree(staging, ignore_errors=True)
    try:
        with progress(desc=f"unpacking {archive.name}", unit="B", unit_scale=True, leave=False, position=1) as unpacking:
            unpacked = unpack_tar(path, staging, archive.place, unpacking)
        content = check_content(archive, staging)
        (root / archive.folder).mkdir(exist_ok=True)
        for file in (staging / archive.folder).iterdir():
            file.replace(root / archive.folder / file.name)
    except BadArchiveError as error:
        path.unlink()
        raise InputError(f"{error}; the archive is deleted, run again to get it anew") from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    write_json(root / archive.marker, {"archive": archive.name, "sha256": file_digest(path), "bytes": unpacked.size} | content)
    if not keep_archives:
        path.unlink()


def download(root: Path, *, keep_archives: bool = False, home: str = MAKE3D_HOME) -> int:
    """Download and unpack what is not there yet, check that all photos have grids; returns the number of archives that were missing.

    Raises:
        InputError: no network, a damaged archive, a disk that is too small, or photos and grids that do not fit together.
    """
    pending = [archive for archive in MAKE3D if not is_complete(archive, root)]
    if pending:
        total = plan(pending, root, home)
        begun = sum(part_size(root / "archives" / archive.name) for archive in pending)
        with progress(total=total, initial=begun, unit="B", unit_scale=True) as bar:
            for number, archive in enumerate(pending, 1):
                bar.set_description(f"{number}/{len(pending)} {archive.name}")
                install(archive, root, home=home, keep_archives=keep_archives, bar=bar)
        with contextlib.suppress(OSError):  # not empty: archives that were to be kept
            (root / "archives").rmdir()
    find_pairs(root)
    return len(pending)


def main(argv: Sequence[str] | None = None, *, home: str = MAKE3D_HOME) -> int:
    """Run the command line; 0 when everything is there. Another home than the public one is for tests.

    Raises:
        SystemExit: code 2, after one line on stderr, for a failed download, a damaged archive, a full disk.
    """
    parser = argparse.ArgumentParser(
        description="Download Make3D's test set (134 photos, 134 laser grids, some 210 MB) from its public home: resumable, checked,"
        " and only what is not there yet."
    )
    parser.add_argument("--root", required=True, type=Path, metavar="DIR", help="folder to fill, then given as MAKE3D_ROOT")
    parser.add_argument("--keep-archives", action="store_true", help="keep the two archives, in DIR/archives; else each goes once unpacked")
    arguments = parser.parse_args(argv)
    with exit_on_input_error():
        check_writable(arguments.root)
        fetched = download(arguments.root, keep_archives=arguments.keep_archives, home=home)
        print(f"{MAKE3D_PHOTOS} photos with their grids, {fetched} of {len(MAKE3D)} archives unpacked now")
        print(f"MAKE3D_ROOT={arguments.root}")
    return 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except KeyboardInterrupt:
        print("stopped; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
