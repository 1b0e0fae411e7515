"""Archives from outside, zip and gzipped tar, unpacked without trusting them.

Every member is checked before the first byte is written, every CRC is verified to the archive's last byte, and the files move to their
place only after all of them are whole.
"""

import functools
import gzip
import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, Any

from tqdm import tqdm

from data_scripts.fetch import SILENT, disk_error, require_space
from dualdepth.errors import InputError

CHUNK = 1 << 20
DAMAGED = (
    *(zipfile.BadZipFile, tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError, NotImplementedError),
    *(RuntimeError, ValueError, LookupError, OverflowError),
)
"""What the readers raise for a truncated, corrupted, encrypted or exotic archive."""
SWELLING, MOST_OF_SMALL = 20, 10**8
"""How many times its own size an archive may unpack to, above so many bytes; images, scans, grids and texts stay far below."""


class BadArchiveError(InputError):
    """An archive that is damaged, that would write where it must not, or that holds other files than it should."""


Member = tuple[str, int, bool, Callable[[], IO[bytes]]]
"""A file of an archive, as it announces itself: name, size, whether it is plain (no link, no special file), and what opens it."""


def unpack(
    archive: str | Path,
    folder: str | Path,
    place: Callable[[str], str | None] = str,
    bar: tqdm = SILENT,
    check: Callable[[Path], dict[str, Any]] = lambda _: {},
) -> dict[str, Any]:
    """Unpack an archive below `folder`, all of it or nothing.

    It is gone through twice: to check every member, then to write.

    Args:
        archive, folder: a zip or a gzipped tar file, and where its files go; made if it is missing.
        place: maps a member's name to its path below `folder`, or to None to leave it out (its CRC is verified all the same).
        bar: set to the archive's total and counted up by the bytes that are read.
        check: called with the folder that the files wait in to be moved; what it raises refuses the archive.

    Returns:
        What was written, as numbers of `files` and `bytes`, and what `check` found.

    Raises:
        BadArchiveError: a truncated or corrupted archive, one that unpacks to far more than its own size, or one with links, special files
            or members that point outside of `folder`.
        InputError: the disk has no room for what the archive announces, or cannot be written.
    """
    archive, folder = Path(archive), Path(folder)
    staging = folder / f".{archive.name}.unpacking"
    try:
        limit = max(MOST_OF_SMALL, SWELLING * archive.stat().st_size)
        with archive.open("rb") as file:
            members = _tar_members if file.read(2) == b"\x1f\x8b" else _zip_members
        targets = [(_target(member, archive, place), member[1]) for member in members(archive, limit)]
        kept = [size for target, size in targets if target is not None]
        require_space(folder, sum(kept), f"unpacking {archive.name}")
        bar.reset(sum(size for _, size in targets))
        shutil.rmtree(staging, ignore_errors=True)  # one may be left of a killed run
        staging.mkdir(parents=True)
        for (*_, opened), (target, _) in zip(members(archive, limit), targets):
            _write(opened, staging / target if target is not None else None, bar)
        found = check(staging)
        for file in [path for path in staging.rglob("*") if path.is_file()]:
            destination = folder / file.relative_to(staging)
            destination.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(file, destination)  # not a rename: a date folder may be a link to another disk
    except DAMAGED as error:
        raise BadArchiveError(f"{archive}: not a whole zip or gzipped tar archive ({error})") from None
    except OSError as error:
        raise disk_error(folder, error) from None
    finally:
        shutil.rmtree(staging, ignore_errors=True)
    return {"files": len(kept), "bytes": sum(kept)} | found


def _zip_members(archive: Path, limit: int) -> Iterator[Member]:
    with zipfile.ZipFile(archive) as zipped:
        infos = [info for info in zipped.infolist() if not info.is_dir()]
        _check_limit(archive, sum(info.file_size for info in infos), limit)
        for info in infos:
            plain = stat.S_IFMT(info.external_attr >> 16) in (0, stat.S_IFREG)
            yield info.filename, info.file_size, plain, functools.partial(zipped.open, info)


def _tar_members(archive: Path, limit: int) -> Iterator[Member]:
    with gzip.open(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        for info in tar:
            _check_limit(archive, info.offset_data + info.size, limit)  # before its bytes are unpacked
            if not info.isdir():
                plain = info.isreg() and not info.issparse()
                yield info.name.removeprefix("./"), info.size, plain, functools.partial(tar.extractfile, info)
        while stream.read(CHUNK):  # what follows the last member is under the CRC as well
            _check_limit(archive, stream.tell(), limit)


def _check_limit(archive: Path, size: int, limit: int) -> None:
    if size > limit:
        raise BadArchiveError(f"{archive}: refused, since it unpacks to more than {limit / 1e9:.1f} GB, too much for its size")


def _target(member: Member, archive: Path, place: Callable[[str], str | None]) -> str | None:
    """Where a member goes, or None; both are checked."""
    name, _, plain, _ = member
    if not plain:
        raise BadArchiveError(f"{archive}: refused, since member {name!r} is a link or a special file")
    target = place(name)
    # Backslashes and colons have no place in the data sets' names, and lead astray on Windows.
    for path in (name, target or "x"):
        if path.startswith("/") or {"..", ".", ""} & set(path.split("/")) or set(path) & set("\\:\0"):
            raise BadArchiveError(f"{archive}: refused, since member {name!r} points outside of the folder")
    return target


def _write(opened: Callable[[], IO[bytes]], target: Path | None, bar: tqdm) -> None:
    """Read a member to its end, which in a zip verifies its CRC and never yields more than it announces; write it if it has a target."""
    if target is not None:
        target.parent.mkdir(parents=True, exist_ok=True)
    with opened() as source, open(target or os.devnull, "wb") as sink:
        while chunk := source.read(CHUNK):
            sink.write(chunk)
            bar.update(len(chunk))
