"""Unpacking of zip and tar archives that cannot be trusted."""

import gzip
import io
import shutil
import stat
import tarfile
import zipfile
from types import SimpleNamespace

import numpy as np
import pytest
from loopback import zip_of
from tqdm import tqdm

from data_scripts.archives import BadArchiveError, unpack, unpack_tar
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


def tar_of(tmp_path, members, name="archive.tar.gz"):
    """A gzipped tar of files (bytes) and of special members (`tarfile.TarInfo`) by name."""
    path = tmp_path / name
    with tarfile.open(path, "w:gz") as tar:
        for member, content in members.items():
            if isinstance(content, tarfile.TarInfo):
                tar.addfile(content)
                continue
            info = tarfile.TarInfo(member)
            info.size = len(content)
            tar.addfile(info, io.BytesIO(content))
    return path


def special(name, kind, target=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


def refuse_tar(archive, folder, match, **settings):
    with pytest.raises(BadArchiveError, match=match):
        unpack_tar(archive, folder, **settings)
    assert not folder.exists() or left_over(folder) == []


def test_members_of_a_tar_are_placed_and_left_out(tmp_path):
    members = {"./": special("./", tarfile.DIRTYPE), "./top/keep/a.txt": b"aaa", "top/drop/b.txt": b"b", "top/c.txt": b""}
    archive = tar_of(tmp_path, members)
    bar = tqdm(disable=False, file=io.StringIO())
    unpacked = unpack_tar(archive, tmp_path / "out", lambda name: None if "drop" in name else name.removeprefix("top/"), bar)
    assert unpacked == (2, 3) and bar.total == bar.n == 3
    assert left_over(tmp_path / "out") == ["a.txt", "c.txt", "keep"]
    assert (tmp_path / "out" / "keep" / "a.txt").read_bytes() == b"aaa"


@pytest.mark.parametrize(
    "name", ["../outside.txt", "a/../../outside.txt", "/outside.txt", "a/./b.txt", "./../outside.txt", "..\\outside.txt", "C:/outside.txt"]
)
@pytest.mark.parametrize("place", [str, lambda name: "wanted.txt"])
def test_members_of_a_tar_that_point_outside_are_refused(tmp_path, name, place):
    archive = tar_of(tmp_path, {"good.txt": b"good", name: b"evil"})
    refuse_tar(archive, tmp_path / "out", "points outside of the folder", place=place)
    assert left_over(tmp_path) == ["archive.tar.gz"]


def test_a_tars_place_that_points_outside_is_refused(tmp_path):
    refuse_tar(tar_of(tmp_path, {"a.txt": b"a"}), tmp_path / "out", "points outside of the folder", place=lambda name: f"../{name}")


@pytest.mark.parametrize("kind", [tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE])
@pytest.mark.parametrize("place", [str, lambda name: name if name == "good.txt" else None])
def test_links_and_devices_in_a_tar_are_refused(tmp_path, kind, place):
    archive = tar_of(tmp_path, {"good.txt": b"good", "odd": special("odd", kind, "good.txt")})
    refuse_tar(archive, tmp_path / "out", "'odd' is a link or a special file", place=place)


@pytest.mark.parametrize("keep", [5, 30, 0.5, -9, -1])
def test_a_truncated_tar_is_refused(tmp_path, keep):
    archive = tar_of(tmp_path, {"a.txt": b"a", "b.bin": np.random.default_rng(0).bytes(50000)})
    whole = archive.read_bytes()
    archive.write_bytes(whole[: keep if isinstance(keep, int) else int(keep * len(whole))])
    refuse_tar(archive, tmp_path / "out", "not a whole gzipped tar archive")


def test_a_corrupted_tar_leaves_nothing(tmp_path):
    archive = tmp_path / "archive.tar.gz"
    plain = gzip.decompress(tar_of(tmp_path, {"good.txt": b"good", "bad.txt": b"corrupt me"}).read_bytes())
    archive.write_bytes(gzip.compress(plain, compresslevel=0).replace(b"corrupt me", b"corrupt ME"))
    refuse_tar(archive, tmp_path / "out", "CRC check failed")
    archive.write_bytes(b"no archive at all")
    refuse_tar(archive, tmp_path / "out", "not a whole gzipped tar archive")
    archive.write_bytes(gzip.compress(b"no tar at all" * 100))
    refuse_tar(archive, tmp_path / "out", "not a whole gzipped tar archive")


def test_a_tar_that_swells_is_refused_before_it_does(tmp_path):
    archive = tar_of(tmp_path, {"zeros.bin": b"\0" * 3_000_000})
    refuse_tar(archive, tmp_path / "out", "unpacks to more than 0.0 GB", limit=1_000_000)
    archive.write_bytes(gzip.compress(gzip.decompress(tar_of(tmp_path, {"a.txt": b"a"}).read_bytes()) + b"\0" * 5_000_000))
    refuse_tar(archive, tmp_path / "out", "unpacks to more than 0.0 GB", limit=1_000_000)


def test_a_tar_without_a_wanted_file_is_refused(tmp_path):
    refuse_tar(tar_of(tmp_path, {"a.txt": b"a"}), tmp_path / "out", "holds none of the files", place=lambda name: None)


def test_what_a_tar_holds_must_fit_the_disk(tmp_path, monkeypatch):
    archive = tar_of(tmp_path, {"a.txt": b"a" * 5_000_000})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    with pytest.raises(InputError, match=r"needs 5\.0 MB of disk and 1\.0 MB are free: 4\.0 MB missing"):
        unpack_tar(archive, tmp_path / "out")
    assert left_over(tmp_path) == ["archive.tar.gz"]
