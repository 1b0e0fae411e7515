"""Archives from outside, zip and gzipped tar, unpacked without trusting them.

Every member is checked before the first byte is written, every CRC is verified, and the files move to their place only
after all of them are whole.
"""

import contextlib
import gzip
import os
import shutil
import stat
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import IO, BinaryIO, NamedTuple

from tqdm import tqdm

from data_scripts.fetch import disk_error, require_space
from dualdepth.errors import InputError

CHUNK = 1 << 20
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError, LookupError)
"""What `zipfile` raises for a truncated, corrupted, encrypted or exotic archive."""
DAMAGED_TAR = (tarfile.TarError, gzip.BadGzipFile, zlib.error, EOFError, ValueError, OverflowError)
"""What `tarfile` and `gzip` raise for one."""
TAR_LIMIT = 4 * 10**9
"""Bytes that a gzipped tar may unpack to, whatever it announces: one of few megabytes can hold terabytes of zeros."""
SWELLING, MOST_OF_SMALL = 50, 10**8
"""How many times its own size a zip may unpack to, above so many bytes; KITTI's images, scans and texts stay far below."""


class BadArchiveError(InputError):
    """An archive that is damaged, or that would write where it must not."""


class Unpacked(NamedTuple):
    """What was written."""

    files: int
    size: int


def unpack(archive: str | Path, folder: str | Path, place: Callable[[str], str | None] = str, bar: tqdm | None = None) -> Unpacked:
    """Unpack a zip archive below `folder`, all of it or nothing.

    Args:
        archive: the zip file.
        folder: made if it is missing.
        place: maps a member's name to its path below `folder`, or to None to leave it out (its CRC is verified all the same).
        bar: set to the archive's total and counted up by the bytes that are read.

    Raises:
        BadArchiveError: a truncated or corrupted archive, or one with links or with members that point outside of `folder`.
        InputError: the disk has no room for what the archive announces, or cannot be written.
    """
    archive, folder = Path(archive), Path(folder)
    staging = folder / f".{archive.stem}.unpacking"
    try:
        with zipfile.ZipFile(archive) as zipped:
            members = [(info, _zip_target(info, archive, place)) for info in zipped.infolist() if not info.is_dir()]
            kept = [info for info, target in members if target is not None]
            size = sum(info.file_size for info in kept)
            if size > max(MOST_OF_SMALL, SWELLING * archive.stat().st_size):
                raise BadArchiveError(
                    f"{archive}: refused, since it unpacks to {size / 1e9:.1f} GB, more than {SWELLING} times its own size"
                )
            require_space(folder, size, f"unpacking {archive.name}")
            if bar is not None:
                bar.reset(sum(info.file_size for info, _ in members))
            with _staged(staging):
                for info, target in members:
                    with zipped.open(info) as source:
                        _write(source, staging / target if target is not None else None, bar)
                _move(staging, folder)
    except DAMAGED as error:
        raise BadArchiveError(f"{archive}: not a whole zip archive ({error})") from None
    except OSError as error:
        raise disk_error(folder, error) from None
    return Unpacked(len(kept), size)


def unpack_tar(
    archive: str | Path, folder: str | Path, place: Callable[[str], str | None] = str, bar: tqdm | None = None, limit: int = TAR_LIMIT
) -> Unpacked:
    """Unpack a gzipped tar archive below `folder`, all of it or nothing.

    It is read twice: once to its end, which checks every member and the CRC of the whole, then to write.

    Args:
        archive: the .tar.gz file.
        folder: made if it is missing.
        place: maps a member's name, without a leading `./`, to its path below `folder`, or to None to leave it out.
        bar: set to the size of the files that are kept and counted up by what is written.
        limit: bytes that the archive may unpack to.

    Raises:
        BadArchiveError: a truncated or corrupted archive, one that unpacks to more than the limit, or one with links, devices or members
            that point outside of `folder`.
        InputError: the disk has no room for it, or cannot be written.
    """
    archive, folder = Path(archive), Path(folder)
    staging = folder / f".{archive.name}.unpacking"
    try:
        kept, size = _check_tar(archive, place, limit)
        require_space(folder, size, f"unpacking {archive.name}")
        if bar is not None:
            bar.reset(size)
        with _staged(staging):
            with gzip.open(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
                for info in tar:
                    if (target := kept.get(info.offset)) is not None and (source := tar.extractfile(info)):
                        _write(source, staging / target, bar)
            _move(staging, folder)
    except DAMAGED_TAR as error:
        raise BadArchiveError(f"{archive}: not a whole gzipped tar archive ({error})") from None
    except OSError as error:
        raise disk_error(folder, error) from None
    return Unpacked(len(kept), size)


def _check_tar(archive: Path, place: Callable[[str], str | None], limit: int) -> tuple[dict[int, str], int]:
    """Read an archive to its end; the targets of the members that are kept, by their offset, and their size."""
    kept: dict[int, str] = {}
    size = 0
    with gzip.open(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        for info in tar:
            if info.offset_data + info.size > limit:  # before its bytes are unpacked
                raise BadArchiveError(f"{archive}: refused, since it unpacks to more than {limit / 1e9:.1f} GB")
            if info.isdir():
                continue
            if not info.isreg() or info.issparse():
                raise BadArchiveError(f"{archive}: refused, since member {info.name!r} is a link or a special file")
            target = _target(info.name.removeprefix("./"), archive, place)
            tarfile.data_filter(info, str(archive.parent))
            if target is not None:
                kept[info.offset] = target
                size += info.size
        while stream.read(CHUNK):  # what follows the last member is under the CRC as well
            if stream.tell() > limit:
                raise BadArchiveError(f"{archive}: refused, since it unpacks to more than {limit / 1e9:.1f} GB")
    if not kept:
        raise BadArchiveError(f"{archive}: holds none of the files that are looked for")
    return kept, size


def _zip_target(info: zipfile.ZipInfo, archive: Path, place: Callable[[str], str | None]) -> str | None:
    """A member's checked path below the folder, or None."""
    if stat.S_IFMT(info.external_attr >> 16) not in (0, stat.S_IFREG):
        raise BadArchiveError(f"{archive}: refused, since member {info.filename!r} is a link or a special file")
    return _target(info.filename, archive, place)


def _target(name: str, archive: Path, place: Callable[[str], str | None]) -> str | None:
    """Where a member of that name goes, checked."""
    target = place(name)
    # Backslashes and colons have no place in the data sets' names, and lead astray on Windows.
    for path in (name, target or "x"):
        if path.startswith("/") or {"..", ".", ""} & set(path.split("/")) or set(path) & set("\\:\0"):
            raise BadArchiveError(f"{archive}: refused, since member {name!r} points outside of the folder")
    return target


@contextlib.contextmanager
def _staged(staging: Path) -> Iterator[None]:
    """A fresh folder to unpack in, removed in any case; one may be left of a killed run."""
    shutil.rmtree(staging, ignore_errors=True)
    staging.mkdir(parents=True)
    try:
        yield
    finally:
        shutil.rmtree(staging, ignore_errors=True)


def _write(source: IO[bytes], target: Path | None, bar: tqdm | None) -> None:
    """Read a member to its end, which in a zip verifies its CRC and never yields more than it announces; write it if it has a target."""
    with contextlib.ExitStack() as files:
        sink: BinaryIO | None = None
        if target is not None:
            target.parent.mkdir(parents=True, exist_ok=True)
            sink = files.enter_context(open(target, "wb"))
        while chunk := source.read(CHUNK):
            if sink is not None:
                sink.write(chunk)
            if bar is not None:
                bar.update(len(chunk))


def _move(staging: Path, folder: Path) -> None:
    for parent, _, names in os.walk(staging):
        destination = folder / Path(parent).relative_to(staging)
        destination.mkdir(parents=True, exist_ok=True)
        for name in names:
            # A move, not a rename: a date folder may be a link to another disk.
            shutil.move(Path(parent) / name, destination / name)
