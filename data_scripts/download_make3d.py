"""Download Make3D's test set from its public home: 134 photos and their laser grids, some 210 MB.

    python data_scripts/download_make3d.py --root MAKE3D

Resumes where it was stopped and does nothing for what is there already. No checksum of the two archives is published: their announced size,
the CRC inside them and their content are verified (134 photos that can be decoded, 134 grids of the right shape, each of one name), and
the sha256 of what came stands in `Test134/.complete.json` and `Gridlaserdata/.complete.json`.
Whoever has Make3D needs none of this: give the folder that holds Test134 and Gridlaserdata as MAKE3D_ROOT.
"""

import argparse
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from data_scripts.archives import BadArchiveError
from data_scripts.download import download, progress
from data_scripts.sources import MAKE3D, MAKE3D_HOME, Archive
from dualdepth.data.make3d import MAKE3D_PHOTOS, find_pairs, read_grid, read_photo
from dualdepth.errors import InputError, exit_on_input_error
from dualdepth.files import check_writable, file_digest


def check_content(archive: Archive, path: Path, folder: Path) -> dict[str, Any]:
    """Read every file that an archive brought, as the evaluation will.

    Returns:
        For the marker: `sha256` of the archive.

    Raises:
        BadArchiveError: there are not 134 of them, or one cannot be read.
    """
    files = sorted(folder.iterdir())
    if len(files) != MAKE3D_PHOTOS:
        raise BadArchiveError(f"{path}: holds {len(files)} files {archive.pattern}, expected {MAKE3D_PHOTOS}")
    try:
        for file in progress(iterable=files, desc=f"checking {archive.folder}", unit="file", leave=False):
            (read_grid if file.suffix == ".mat" else read_photo)(file)
    except InputError as error:
        raise BadArchiveError(str(error)) from None
    return {"sha256": file_digest(path)}


def main(argv: Sequence[str] | None = None, *, home: str = MAKE3D_HOME) -> None:
    """Run the command line; a failed download, a damaged archive or a full disk is one line on stderr and exit code 2.

    Another home than the public one is for tests.
    """
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", required=True, type=Path, metavar="DIR", help="folder to fill, then given as MAKE3D_ROOT")
    parser.add_argument("--keep-archives", action="store_true", help="keep the two archives, in DIR/archives; else each goes once unpacked")
    with exit_on_input_error():
        given = parser.parse_args(argv)
        check_writable(given.root)
        fetched = download(MAKE3D, given.root, home, check=check_content, keep_archives=given.keep_archives)
        find_pairs(given.root)
        print(f"{MAKE3D_PHOTOS} photos with their grids, {fetched} of {len(MAKE3D)} archives unpacked now")
        print(f"MAKE3D_ROOT={given.root}")


if __name__ == "__main__":
    main()
