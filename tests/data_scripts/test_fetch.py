"""Downloads, against a real HTTP server on loopback."""

import errno
import hashlib
import io
import socket
import urllib.request
from unittest.mock import Mock

import pytest
from loopback import files
from tqdm import tqdm

import data_scripts.fetch as module
from data_scripts.fetch import fetch, remote_size
from dualdepth.errors import InputError

CONTENT = bytes(range(256)) * 8192  # 2 MiB
SHA256 = f"sha256:{hashlib.sha256(CONTENT).hexdigest()}"


@pytest.fixture
def server(bare_server):
    bare_server.files["file.bin"] = CONTENT
    return bare_server


def get(server, folder, **settings):
    return fetch(f"{server.home}file.bin", folder / "file.bin", **settings)


def test_a_file_arrives_whole_and_alone(server, tmp_path):
    assert get(server, tmp_path / "new" / "folder", digest=SHA256).read_bytes() == CONTENT
    assert files(tmp_path / "new" / "folder") == ["file.bin"]
    assert remote_size(f"{server.home}file.bin") == len(CONTENT)


def test_a_cut_connection_is_resumed_and_only_the_rest_is_sent(server, tmp_path):
    server.cuts = [300_000] * 6  # more cuts than attempts in a row are made: bytes that come reset the patience
    assert get(server, tmp_path, digest=SHA256).read_bytes() == CONTENT
    assert server.sent == [*[300_000] * 6, len(CONTENT) - 1_800_000]
    assert [asked for _, _, asked, _ in server.requests] == [None, *(f"bytes={k * 300_000}-" for k in range(1, 7))]


@pytest.mark.parametrize("changed", [False, True])
def test_a_second_run_goes_on_where_the_first_gave_up_unless_the_file_changed(server, tmp_path, changed):
    server.cuts = [500_000, 0, 0, 0]
    with pytest.raises(InputError, match=r"keeps breaking .* run again, it goes on after 0\.5 MB"):
        get(server, tmp_path)
    assert files(tmp_path) == ["file.bin.part", "file.bin.part.etag"]
    if changed:
        server.files["file.bin"], server.etags["file.bin"] = CONTENT[::-1], '"second"'
    bar = tqdm(initial=500_000 + 7, file=io.StringIO())  # 7 bytes of another file
    assert get(server, tmp_path, bar=bar).read_bytes() == server.files["file.bin"]
    assert server.sent[-1] == len(CONTENT) - (0 if changed else 500_000) and bar.n == len(CONTENT) + 7


@pytest.mark.parametrize(
    ("part", "mark", "sent"),
    [(CONTENT, '"first"', 0), (b"of who knows what", "", len(CONTENT)), (CONTENT + b"more", '"first"', len(CONTENT))],
    ids=["stopped just before the end", "without a mark of the version", "beyond the end"],
)
def test_a_part_of_another_run_is_taken_for_what_it_is(server, tmp_path, part, mark, sent):
    (tmp_path / "file.bin.part").write_bytes(part)
    (tmp_path / "file.bin.part.etag").write_text(mark)
    assert get(server, tmp_path, digest=SHA256).read_bytes() == CONTENT
    assert sum(server.sent) == sent and files(tmp_path) == ["file.bin"]


def test_a_server_without_ranges_starts_over(server, tmp_path):
    server.ranges, server.cuts = False, [500_000]
    assert get(server, tmp_path, digest=SHA256).read_bytes() == CONTENT
    assert server.sent == [500_000, len(CONTENT)]


def test_a_failing_server_is_asked_again(server, tmp_path):
    server.failures = [503, 500]
    assert get(server, tmp_path, digest=SHA256).read_bytes() == CONTENT
    server.failures = [503] * 3
    with pytest.raises(InputError, match=r"the server fails .HTTP 503.; try again later"):
        fetch(f"{server.home}file.bin", tmp_path / "other")


def test_a_wrong_checksum_is_told_and_leaves_nothing(server, tmp_path):
    with pytest.raises(InputError, match="wrong checksum, md5 is"):
        get(server, tmp_path, digest="md5:" + "0" * 32)
    assert files(tmp_path) == []


def test_a_file_that_is_there_is_verified_without_the_network(server, tmp_path):
    (tmp_path / "file.bin").write_bytes(CONTENT)
    get(server, tmp_path, digest=SHA256)
    (tmp_path / "file.bin").write_bytes(b"edited")
    with pytest.raises(InputError, match="delete it to have it downloaded again"):
        get(server, tmp_path, digest=SHA256)
    assert (tmp_path / "file.bin").read_bytes() == b"edited"
    assert server.requests == []


def test_a_missing_file_is_told_at_once(server, tmp_path):
    for action in (lambda: fetch(f"{server.home}nothing", tmp_path / "nothing"), lambda: remote_size(f"{server.home}nothing")):
        with pytest.raises(InputError, match=r"nothing: not there \(HTTP 404\)"):
            action()
    assert len(server.requests) == 2
    assert files(tmp_path) == []


def test_no_network_is_told_with_the_mend(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "PAUSES", (0.0, 0.0))
    with socket.socket() as taken:  # bound and never listening: refuses connections
        taken.bind(("127.0.0.1", 0))
        with pytest.raises(InputError, match=r"no network: .* cannot be reached .* if you have the data set, .* KITTI_ROOT"):
            remote_size(f"http://127.0.0.1:{taken.getsockname()[1]}/file")


def test_redirects_are_not_followed():
    request = urllib.request.Request("https://example.org/a")
    with pytest.raises(InputError, match=r"redirects to https://elsewhere\.org"):
        module._NoRedirect().redirect_request(request, None, 302, "Found", {}, "https://elsewhere.org/a")


def test_a_full_disk_is_told_once_and_not_retried(server, tmp_path, monkeypatch):
    monkeypatch.setattr(module, "write_text", Mock(side_effect=OSError(errno.ENOSPC, "No space left on device")))
    with pytest.raises(InputError, match="the disk is full"):
        get(server, tmp_path)
    assert len(server.requests) == 1
