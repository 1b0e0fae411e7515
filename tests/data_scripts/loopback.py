"""A real HTTP server on loopback, with ranges, that can be told to misbehave; and zip archives to serve."""

import http.server
import io
import re
import tarfile
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from data_scripts import fetch


class Loopback(http.server.ThreadingHTTPServer):
    """Serves `files` by path; `requests` is the log of (method, path, Range header, bytes sent)."""

    daemon_threads = True

    def __init__(self) -> None:
        super().__init__(("127.0.0.1", 0), _Handler)
        self.files: dict[str, bytes] = {}
        self.etags: dict[str, str] = {}
        self.requests: list[tuple[str, str, str | None, int]] = []
        self.cuts: list[int] = []  # each GET takes one: bytes after which its connection is cut
        self.failures: list[int] = []  # each GET takes one: an HTTP status to fail with
        self.ranges = True
        self.home = f"http://127.0.0.1:{self.server_address[1]}/"

    @property
    def sent(self) -> list[int]:
        """Bytes of content sent by each GET that found its file."""
        return [size for method, _, _, size in self.requests if method == "GET"]


class _Handler(http.server.BaseHTTPRequestHandler):
    server: Loopback

    def log_message(self, *_: object) -> None:
        pass

    def do_GET(self) -> None:
        server, path, asked, with_body = self.server, self.path.lstrip("/"), self.headers["Range"], self.command == "GET"
        failure = server.failures.pop(0) if with_body and server.failures else None
        content, etag = server.files.get(path), server.etags.get(path, '"first"')
        status, headers, body = failure or 404, {}, b""
        if content is not None and not failure:
            start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1]) if asked and server.ranges and self.headers["If-Range"] == etag else 0
            status, headers, body = 200, {"ETag": etag}, content[start:]
            if start:
                status = 206 if body else 416
                headers["Content-Range"] = f"bytes {f'{start}-{len(content) - 1}' if body else '*'}/{len(content)}"
        headers["Content-Length"] = str(len(body))
        if not with_body:
            body = b""
        elif body and server.cuts:
            body = body[: server.cuts.pop(0)]
        server.requests.append((self.command, path, asked, len(body)))  # before the answer, which a client may not read to its end
        self.send_response(status)
        for header in headers.items():
            self.send_header(*header)
        self.end_headers()
        self.wfile.write(body)
        self.close_connection = True

    def do_HEAD(self) -> None:
        self.do_GET()


@pytest.fixture
def bare_server(monkeypatch) -> Iterator[Loopback]:
    """A server that answers during a test, past any proxy and without pauses between attempts."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetch, "PAUSES", (0.0, 0.0))
    with Loopback() as server:
        threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True).start()
        yield server
        server.shutdown()


def files(folder: Path) -> list[str]:
    """All files below a folder, by their paths."""
    return sorted(str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file())


def zip_of(members: dict[str | zipfile.ZipInfo, bytes]) -> bytes:
    """A zip archive, uncompressed, so that a test can find a member's bytes in it."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as zipped:
        for name, content in members.items():
            zipped.writestr(name, content)
    return buffer.getvalue()


def tar_of(members: dict[str, bytes | tarfile.TarInfo]) -> bytes:
    """A gzipped tar of files, and of special members."""
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w:gz") as tar:
        for name, content in members.items():
            special = isinstance(content, tarfile.TarInfo)
            info = content if special else tarfile.TarInfo(name)
            info.size = 0 if special else len(content)
            tar.addfile(info, None if special else io.BytesIO(content))
    return buffer.getvalue()
