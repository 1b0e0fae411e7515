"""Zip archives from outside, unpacked without trusting them.

Every member is checked before the first byte is written, every byte's CRC is verified, and the files move to their place only
after all of them are whole.
"""

import contextlib
import os
import shutil
import stat
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import BinaryIO, NamedTuple

from tqdm import tqdm

from dualdepth.data.download import disk_error, require_space
from dualdepth.errors import InputError

CHUNK = 1 << 20
DAMAGED = (zipfile.BadZipFile, zlib.error, EOFError, NotImplementedError, RuntimeError, ValueError)
"""What `zipfile` raises for a truncated, corrupted, encrypted or exotic archive."""


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
            members = [(info, _target(info, archive, place)) for info in zipped.infolist() if not info.is_dir()]
            kept = [info for info, target in members if target is not None]
            size = sum(info.file_size for info in kept)
            require_space(folder, size, f"unpacking {archive.name}")
            if bar is not None:
                bar.reset(sum(info.file_size for info, _ in members))
            with _staged(staging):
                for info, target in members:
                    _write(zipped, info, staging / target if target is not None else None, bar)
                _move(staging, folder)
    except DAMAGED as error:
        raise BadArchiveError(f"{archive}: not a whole zip archive ({error})") from None
    except OSError as error:
        raise disk_error(folder, error) from None
    return Unpacked(len(kept), size)


def _target(info: zipfile.ZipInfo, archive: Path, place: Callable[[str], str | None]) -> str | None:
    """A member's checked path below the folder, or None."""
    name, mode = info.filename, info.external_attr >> 16
    if stat.S_IFMT(mode) not in (0, stat.S_IFREG):
        raise BadArchiveError(f"{archive}: refused, since member {name!r} is a link or a special file")
    target = place(name)
    # Backslashes and colons have no place in KITTI's names, and lead astray on Windows.
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


def _write(zipped: zipfile.ZipFile, info: zipfile.ZipInfo, target: Path | None, bar: tqdm | None) -> None:
    """Read a member to its end, which verifies its CRC and never yields more than it announces; write it if it has a target."""
    with contextlib.ExitStack() as files:
        source = files.enter_context(zipped.open(info))
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
