"""A real HTTP server on loopback, with ranges, that can be told to misbehave; and zip archives to serve."""

import http.server
import io
import re
import tarfile
import threading
import zipfile
from collections.abc import Iterator

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
        log = [self.command, path, asked, 0]
        failure = server.failures.pop(0) if with_body and server.failures else None
        if failure or path not in server.files:
            server.requests.append(tuple(log))
            self.send_error(failure or 404)
            return
        content, etag = server.files[path], server.etags.get(path, '"first"')
        start = int(re.fullmatch(r"bytes=(\d+)-", asked)[1]) if asked and server.ranges and self.headers["If-Range"] == etag else 0
        if start >= len(content) > 0 and start:
            server.requests.append(tuple(log))
            self.send_response(416)
            self.send_header("Content-Range", f"bytes */{len(content)}")
            self.send_header("Content-Length", "0")
            self.end_headers()
            return
        body = content[start:]
        if with_body:
            body = body[: server.cuts.pop(0)] if server.cuts else body
            log[3] = len(body)
        server.requests.append(tuple(log))  # before the answer, which a client may not read to its end
        self.send_response(206 if start else 200)
        if start:
            self.send_header("Content-Range", f"bytes {start}-{len(content) - 1}/{len(content)}")
        self.send_header("Content-Length", str(len(content) - start))
        self.send_header("ETag", etag)
        self.end_headers()
        if with_body:
            self.wfile.write(body)
        self.close_connection = True

    def do_HEAD(self) -> None:
        self.do_GET()


@pytest.fixture
def bare_server(monkeypatch) -> Iterator[Loopback]:
    """A server that answers during a test, past any proxy and without pauses between attempts."""
    monkeypatch.setenv("no_proxy", "127.0.0.1")
    monkeypatch.setattr(fetch, "PAUSES", (0.0, 0.0))
    server = Loopback()
    thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02}, daemon=True)
    thread.start()
    try:
        yield server
    finally:
        server.shutdown()
        server.server_close()
        thread.join()


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
