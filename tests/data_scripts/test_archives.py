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
from loopback import files, tar_of, zip_of
from tqdm import tqdm

from data_scripts import archives
from data_scripts.archives import BadArchiveError, unpack
from dualdepth.errors import InputError


def special(name, kind, target=""):
    info = tarfile.TarInfo(name)
    info.type, info.linkname = kind, target
    return info


@pytest.fixture(params=[zip_of, tar_of], ids=["zip", "tar"])
def archive_of(request, tmp_path):
    """Writes an archive of these members, of either kind."""

    def write(members):
        path = tmp_path / ("a.zip" if request.param is zip_of else "a.tar.gz")
        path.write_bytes(request.param(members))
        return path

    return write


def write(path, content):
    path.write_bytes(content)
    return path


def refuse(archive, match, kind=BadArchiveError, **settings):
    folder = archive.parent / "out"
    with pytest.raises(kind, match=match):
        unpack(archive, folder, **settings)
    assert files(archive.parent) == [archive.name] and not list(folder.glob("*"))


def test_members_are_placed_and_left_out_and_all_are_read(archive_of, tmp_path):
    archive = archive_of({"top/keep/a.txt": b"aaa", "top/drop/b.txt": b"b", "top/c.txt": b""})
    rest = tmp_path / "out" / f".{archive.name}.unpacking"  # of a killed run
    rest.mkdir(parents=True)
    (rest / "stale").touch()
    bar = tqdm(disable=False, file=io.StringIO())
    unpacked = unpack(archive, tmp_path / "out", lambda name: None if "drop" in name else name.removeprefix("top/"), bar)
    assert unpacked == {"files": 2, "bytes": 3} and bar.total == bar.n == 4
    assert files(tmp_path / "out") == ["c.txt", "keep/a.txt"]
    assert (tmp_path / "out" / "keep" / "a.txt").read_bytes() == b"aaa"


def test_folders_of_a_tar_and_dots_before_its_names_are_passed_over(tmp_path):
    archive = write(tmp_path / "a.tar.gz", tar_of({"./": special("./", tarfile.DIRTYPE), "./top/a.txt": b"aaa"}))
    assert unpack(archive, tmp_path / "out")["files"] == 1 and files(tmp_path / "out") == ["top/a.txt"]


OUTSIDE = ["../outside.txt", "a/../../outside.txt", "/outside.txt", "a/./b.txt", "./../outside.txt", "..\\outside.txt", "C:/outside.txt"]


@pytest.mark.parametrize("name", OUTSIDE)
def test_members_and_places_that_point_outside_are_refused(archive_of, name):
    for member, place in ((name, str), (name, lambda _: "wanted.txt"), ("evil.txt", lambda _: name)):
        refuse(archive_of({"good.txt": b"good", member: b"evil"}), "points outside of the folder", place=place)


def zip_with_a_link():
    link = zipfile.ZipInfo("odd")
    link.external_attr = (stat.S_IFLNK | 0o777) << 16
    return zip_of({"good.txt": b"good", link: b"/etc"})


@pytest.mark.parametrize("kind", [None, tarfile.SYMTYPE, tarfile.LNKTYPE, tarfile.CHRTYPE, tarfile.BLKTYPE, tarfile.FIFOTYPE])
@pytest.mark.parametrize("place", [str, lambda name: name if name == "good.txt" else None])
def test_links_and_devices_are_refused_even_where_they_are_not_wanted(tmp_path, kind, place):
    content = tar_of({"good.txt": b"good", "odd": special("odd", kind, "good.txt")}) if kind else zip_with_a_link()
    refuse(write(tmp_path / "a", content), "'odd' is a link or a special file", place=place)


@pytest.mark.parametrize("keep", [0, 5, 30, 25_000, -9, -1])
def test_a_truncated_archive_is_refused(archive_of, keep):
    archive = archive_of({"a.txt": b"a", "b.bin": np.random.default_rng(0).bytes(50000)})
    refuse(write(archive, archive.read_bytes()[:keep]), "not a whole zip or gzipped tar archive")


@pytest.mark.parametrize("place", [str, lambda name: None if name == "bad.txt" else name])
def test_a_corrupted_member_leaves_nothing_even_when_it_is_not_wanted(tmp_path, place):
    members = {"good.txt": b"good", "bad.txt": b"corrupt me"}
    archive = write(tmp_path / "a.zip", zip_of(members).replace(b"corrupt me", b"corrupt ME"))
    refuse(archive, r"Bad CRC-32 for file 'bad.txt'", place=place)
    plain = gzip.compress(gzip.decompress(tar_of(members)), compresslevel=0)
    refuse(write(archive, plain.replace(b"corrupt me", b"corrupt ME")), "CRC check failed", place=place)


@pytest.mark.parametrize("content", [b"no archive at all", gzip.compress(b"no tar at all" * 100)], ids=["text", "gzip"])
def test_what_is_no_archive_is_refused(tmp_path, content):
    refuse(write(tmp_path / "a", content), "not a whole zip or gzipped tar archive")


def test_what_the_archive_announces_must_fit_the_disk(archive_of, monkeypatch):
    archive = archive_of({"a.txt": b"a" * 5_000_000})
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=10**6))
    refuse(archive, r"needs 5\.0 MB of disk and 1\.0 MB are free: 4\.0 MB missing", InputError)


def test_a_member_of_a_zip_never_yields_more_than_it_announces(tmp_path):
    content = zip_of({"a.txt": b"a" * 5000}).replace((5000).to_bytes(4, "little"), (10).to_bytes(4, "little"))
    refuse(write(tmp_path / "a.zip", content), "not a whole zip")


SWELLING = {
    "zip": lambda: zip_of({"zeros.bin": bytes(3_000_000)}),
    "tar": lambda: tar_of({"zeros.bin": bytes(3_000_000)}),
    "between the files of a tar": lambda: tar_of({str(k): special(str(k), tarfile.DIRTYPE) for k in range(3000)}),
    "behind the files of a tar": lambda: gzip.compress(gzip.decompress(tar_of({"a.txt": b"a"})) + bytes(5_000_000)),
}


@pytest.mark.parametrize("case", SWELLING)
def test_an_archive_that_swells_is_refused_before_it_does(tmp_path, monkeypatch, case):
    monkeypatch.setattr(archives, "MOST_OF_SMALL", 1_000_000)
    monkeypatch.setattr(archives, "SWELLING", 0)
    refuse(write(tmp_path / "a", SWELLING[case]()), "unpacks to more than 0.0 GB")


def test_what_a_check_refuses_leaves_nothing_and_what_it_finds_is_told(archive_of, tmp_path):
    def check(folder):
        if files(folder) != ["a.txt"]:
            raise BadArchiveError("other files")
        return {"found": 1}

    refuse(archive_of({"b.txt": b"b"}), "other files", check=check)
    assert unpack(archive_of({"a.txt": b"a"}), tmp_path / "out", check=check)["found"] == 1
