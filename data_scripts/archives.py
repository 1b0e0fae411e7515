"""Archives from outside, zip and gzipped tar, unpacked without trusting them.

Every member is checked before the first byte is written, every CRC is verified to the archive's last byte, and the files move to their
place only after all of them are whole.
"""

import contextlib
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
from typing import IO, Any, NamedTuple

from tqdm import tqdm

from data_scripts.fetch import disk_error, require_space
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


class Member(NamedTuple):
    """One file of an archive, as it announces itself."""

    name: str
    size: int
    plain: bool
    """False: a link or a special file."""
    open: Callable[[], IO[bytes]]


class Unpacked(NamedTuple):
    """What was written."""

    files: int
    size: int
    found: dict[str, Any]
    """By `check`."""


def unpack(
    archive: str | Path,
    folder: str | Path,
    place: Callable[[str], str | None] = str,
    bar: tqdm | None = None,
    *,
    check: Callable[[Path], dict[str, Any]] = lambda _: {},
    limit: int | None = None,
) -> Unpacked:
    """Unpack an archive below `folder`, all of it or nothing.

    It is gone through twice: to check every member, then to write.

    Args:
        archive: a zip or a gzipped tar file.
        folder: made if it is missing.
        place: maps a member's name to its path below `folder`, or to None to leave it out (its CRC is verified all the same).
        bar: set to the archive's total and counted up by the bytes that are read.
        check: called with the folder that the files wait in to be moved; what it raises refuses the archive.
        limit: bytes that it may unpack to; else a multiple of its own size.

    Raises:
        BadArchiveError: a truncated or corrupted archive, one that unpacks to more than the limit, or one with links, special files or
            members that point outside of `folder`.
        InputError: the disk has no room for what the archive announces, or cannot be written.
    """
    archive, folder = Path(archive), Path(folder)
    staging = folder / f".{archive.name}.unpacking"
    try:
        limit = limit or max(MOST_OF_SMALL, SWELLING * archive.stat().st_size)
        members = _reader(archive, limit)
        targets = [(_target(member, archive, place), member.size) for member in members()]
        kept = [size for target, size in targets if target is not None]
        require_space(folder, sum(kept), f"unpacking {archive.name}")
        if bar is not None:
            bar.reset(sum(size for _, size in targets))
        with _staged(staging):
            for member, (target, _) in zip(members(), targets):
                _write(member, staging / target if target is not None else None, bar)
            found = check(staging)
            _move(staging, folder)
    except DAMAGED as error:
        raise BadArchiveError(f"{archive}: not a whole zip or gzipped tar archive ({error})") from None
    except OSError as error:
        raise disk_error(folder, error) from None
    return Unpacked(len(kept), sum(kept), found)


def _reader(archive: Path, limit: int) -> Callable[[], Iterator[Member]]:
    """What goes through the members of an archive, whose kind its first bytes tell."""
    with archive.open("rb") as file:
        return functools.partial(_tar_members if file.read(2) == b"\x1f\x8b" else _zip_members, archive, limit)


def _zip_members(archive: Path, limit: int) -> Iterator[Member]:
    with zipfile.ZipFile(archive) as zipped:
        infos = [info for info in zipped.infolist() if not info.is_dir()]
        _check_limit(archive, sum(info.file_size for info in infos), limit)
        for info in infos:
            plain = stat.S_IFMT(info.external_attr >> 16) in (0, stat.S_IFREG)
            yield Member(info.filename, info.file_size, plain, functools.partial(zipped.open, info))


def _tar_members(archive: Path, limit: int) -> Iterator[Member]:
    with gzip.open(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        for info in tar:
            _check_limit(archive, info.offset_data + info.size, limit)  # before its bytes are unpacked
            if not info.isdir():
                plain = info.isreg() and not info.issparse()
                yield Member(info.name.removeprefix("./"), info.size, plain, functools.partial(tar.extractfile, info))
        while stream.read(CHUNK):  # what follows the last member is under the CRC as well
            _check_limit(archive, stream.tell(), limit)


def _check_limit(archive: Path, size: int, limit: int) -> None:
    if size > limit:
        raise BadArchiveError(f"{archive}: refused, since it unpacks to more than {limit / 1e9:.1f} GB, too much for its size")


def _target(member: Member, archive: Path, place: Callable[[str], str | None]) -> str | None:
    """Where a member goes, or None; both are checked."""
    if not member.plain:
        raise BadArchiveError(f"{archive}: refused, since member {member.name!r} is a link or a special file")
    target = place(member.name)
    # Backslashes and colons have no place in the data sets' names, and lead astray on Windows.
    for path in (member.name, target or "x"):
        if path.startswith("/") or {"..", ".", ""} & set(path.split("/")) or set(path) & set("\\:\0"):
            raise BadArchiveError(f"{archive}: refused, since member {member.name!r} points outside of the folder")
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


def _write(member: Member, target: Path | None, bar: tqdm | None) -> None:
    """Read a member to its end, which in a zip verifies its CRC and never yields more than it announces; write it if it has a target."""
    if target is not None:
        target.parent.mkdir(parents=True, exist_ok=True)
    with member.open() as source, open(target or os.devnull, "wb") as sink:
        while chunk := source.read(CHUNK):
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
