"""Unpacking of zip archives that cannot be trusted."""

import shutil
import stat
import zipfile
from types import SimpleNamespace

import pytest
from loopback import zip_of

from dualdepth.data.unpacking import BadArchiveError, unpack
from dualdepth.errors import InputError


def left_over(folder):
    return sorted(path.name for path in folder.rglob("*"))


def archive_of(tmp_path, members):
    path = tmp_path / "archive.zip"
    path.write_bytes(zip_of(members))
    return path


def test_members_are_placed_and_left_out(tmp_path):
    archive = archive_of(tmp_path, {"top/keep/a.txt": b"a", "top/drop/b.txt": b"b"})
    unpacked = unpack(archive, tmp_path / "out", lambda name: None if "drop" in name else name.removeprefix("top/"))
    assert unpacked == (1, 1)
    assert left_over(tmp_path / "out") == ["a.txt", "keep"]


def refuse(archive, folder, match):
    with pytest.raises(BadArchiveError, match=match):
        unpack(archive, folder)
    assert not folder.exists() or left_over(folder) == []


@pytest.mark.parametrize(
    "name", ["../outside.txt", "a/../../outside.txt", "/outside.txt", "a/./b.txt", "..\\outside.txt", "C:/outside.txt"]
)
def test_members_that_point_outside_are_refused(tmp_path, name):
    refuse(archive_of(tmp_path, {"good.txt": b"good", name: b"evil"}), tmp_path / "out", "points outside of the folder")
    assert left_over(tmp_path) == ["archive.zip"]


def test_links_are_refused(tmp_path):
    link = zipfile.ZipInfo("link")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    refuse(archive_of(tmp_path, {"good.txt": b"good", link: b"/etc"}), tmp_path / "out", "'link' is a link")


@pytest.mark.parametrize("keep", [30, 1000, -1])
def test_a_truncated_archive_is_refused(tmp_path, keep):
    archive = archive_of(tmp_path, {"a.txt": b"a" * 5000})
    archive.write_bytes(archive.read_bytes()[:keep])
    refuse(archive, tmp_path / "out", "not a whole zip archive")


@pytest.mark.parametrize("place", [str, lambda name: None if name == "bad.txt" else name])
def test_a_corrupted_member_leaves_nothing_even_when_it_is_not_wanted(tmp_path, place):
    archive = archive_of(tmp_path, {"good.txt": b"good", "bad.txt": b"corrupt me"})
    archive.write_bytes(archive.read_bytes().replace(b"corrupt me", b"corrupt ME"))
    with pytest.raises(BadArchiveError, match=r"Bad CRC-32 for file 'bad.txt'"):
        unpack(archive, tmp_path / "out", place)
    assert left_over(tmp_path / "out") == []


def test_what_the_archive_announces_must_fit_the_disk(tmp_path, monkeypatch):
    archive = archive_of(tmp_path, {"a.txt": b"a" * 5_000_000})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    with pytest.raises(InputError, match=r"needs 5\.0 MB of disk and 1\.0 MB are free: 4\.0 MB missing"):
        unpack(archive, tmp_path / "out")
    assert left_over(tmp_path) == ["archive.zip"]


def test_a_member_never_yields_more_than_it_announces(tmp_path):
    archive = archive_of(tmp_path, {"a.txt": b"a" * 5000})
    announced = (5000).to_bytes(4, "little")
    archive.write_bytes(archive.read_bytes().replace(announced, (10).to_bytes(4, "little")))
    refuse(archive, tmp_path / "out", "not a whole zip archive")


def test_unpacking_over_an_interrupted_run_starts_afresh(tmp_path):
    archive = archive_of(tmp_path, {"a/b.txt": b"new"})
    (tmp_path / "out" / ".archive.unpacking").mkdir(parents=True)
    (tmp_path / "out" / ".archive.unpacking" / "stale").write_bytes(b"old")
    unpack(archive, tmp_path / "out")
    assert left_over(tmp_path / "out") == ["a", "b.txt"]
