"""Downloads that resume and are verified, with the standard library alone.

A download grows as `NAME.part`, beside it `NAME.part.etag` with the server's mark of that version of the file; it takes its name
once it is whole and its checksum, where one is known, is right. A broken connection, or a second run, goes on where the first ended.
"""

import errno
import hashlib
import http.client
import shutil
import socket
import ssl
import time
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

from tqdm import tqdm

from dualdepth.errors import InputError
from dualdepth.files import write_text

CHUNK = 1 << 18
TIMEOUT = 30.0  # seconds without a byte after which a connection counts as broken
PAUSES = (1.0, 2.0, 5.0, 10.0, 30.0)  # seconds before each new attempt; attempts are counted anew whenever bytes came
SILENT = tqdm(disable=True)
BROKEN = (urllib.error.URLError, ConnectionError, TimeoutError, http.client.HTTPException)
"""What another attempt may mend; the disk's errors are none of these."""


class _NoRedirect(urllib.request.HTTPRedirectHandler):
    def redirect_request(self, req, fp, code, msg, headers, newurl):
        raise InputError(f"{req.full_url}: redirects to {newurl}, which is not followed; the public address may have moved")


def remote_size(address: str) -> int:
    """Size in bytes that the server announces for a file, without downloading it.

    Raises:
        InputError: no network, no such file, or a server that does not say.
    """
    mend = "if you have the data set, give its folder as KITTI_ROOT, ODOMETRY_ROOT or MAKE3D_ROOT"
    with _with_retries(lambda: _open(address, method="HEAD"), address, mend) as response:
        size = response.headers["Content-Length"]
    if size is None:
        raise InputError(f"{address}: the server does not say how large the file is; try again later")
    return int(size)


def fetch(address: str, path: str | Path, *, digest: str | None = None, bar: tqdm = SILENT) -> Path:
    """Download `address` to `path`, going on from an earlier `.part`; a file that is already at `path` is only verified.

    Args:
        digest: `sha256:<hex>` or `md5:<hex>` of the whole file, where it is known.
        bar: counts the bytes that the `.part` grows by (a restart counts back).

    Raises:
        InputError: no network, no such file, a wrong checksum (the download is then deleted), a full disk.
    """
    path = Path(path)
    if path.exists():
        if wrong := _wrong_checksum(path, digest):
            raise InputError(f"{path}: {wrong}; it differs from {address}; delete it to have it downloaded again")
        return path
    partial, mark = path.with_name(f"{path.name}.part"), path.with_name(f"{path.name}.part.etag")
    try:
        _with_retries(lambda: _transfer(address, partial, mark, bar), address, f"or put it at {path} yourself", lambda: part_size(path))
        if wrong := _wrong_checksum(partial, digest):
            partial.unlink()
            raise InputError(f"{partial}: {wrong}; the download is deleted; run again")
        partial.replace(path)
    except OSError as error:
        raise disk_error(path, error) from None
    finally:
        if not partial.exists():
            mark.unlink(missing_ok=True)
    return path


def part_size(path: Path) -> int:
    """Bytes of `path` that are on disk already, whole or in part."""
    return next((file.stat().st_size for file in (path, path.with_name(f"{path.name}.part")) if file.exists()), 0)


def require_space(folder: Path, needed: float, what: str) -> None:
    """Check that the disk of `folder` (which may not exist yet) has `needed` bytes free.

    Raises:
        InputError: it has not; the message names what is missing.
    """
    folder = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    free = shutil.disk_usage(folder).free
    if needed > free:
        sizes = f"{gigabytes(needed)} of disk and {gigabytes(free)} are free: {gigabytes(needed - free)} missing"
        raise InputError(f"{folder}: {what} needs {sizes}; free some, or choose another folder or fewer drives")


def gigabytes(size: float) -> str:
    """A size in bytes for people, in GB of 10⁹ bytes (MB below a tenth of that)."""
    return f"{size / 1e9:.1f} GB" if size >= 1e8 else f"{size / 1e6:.1f} MB"


def disk_error(path: Path, error: OSError) -> InputError:
    """The one-line error of a file that could not be written."""
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return InputError(f"{path}: the disk is full; free some space and run again (the download goes on where it stopped)")
    return InputError(f"{path}: cannot be written ({error.strerror or error})")


def _wrong_checksum(path: Path, digest: str | None) -> str | None:
    """What is wrong with the file's checksum; None: nothing, or none is known."""
    if digest is None:
        return None
    method, expected = digest.split(":")
    with open(path, "rb") as file:
        found = hashlib.file_digest(file, method).hexdigest()
    return None if found == expected else f"wrong checksum, {method} is {found[:16]}… and not {expected[:16]}…"


def _open(address: str, headers: dict[str, str] | None = None, method: str = "GET") -> http.client.HTTPResponse:
    """Open an address; follows no redirect."""
    # Identity, since ranges of a compressed transfer would not be ranges of the file.
    request = urllib.request.Request(address, headers={"Accept-Encoding": "identity"} | (headers or {}), method=method)
    try:
        return urllib.request.build_opener(_NoRedirect).open(request, timeout=TIMEOUT)
    except urllib.error.HTTPError as error:
        error.close()
        if error.code in (416, 429) or error.code >= 500:
            raise
        if error.code in (403, 404, 410):  # Amazon's storage answers 403 for a file that does not exist
            raise InputError(f"{address}: not there (HTTP {error.code}); check the name") from None
        raise InputError(f"{address}: the server refuses (HTTP {error.code} {error.reason})") from None


def _transfer(address: str, partial: Path, mark: Path, bar: tqdm) -> None:
    """One connection's worth of a download: append to `partial` if the server still has the same file, else start over."""
    have = partial.stat().st_size if partial.exists() else 0
    version = mark.read_text(encoding="utf-8") if have and mark.exists() else ""
    headers = {"Range": f"bytes={have}-", "If-Range": version} if version else {}
    try:
        response = _open(address, headers)
    except urllib.error.HTTPError as error:
        if error.code == 416 and error.headers["Content-Range"] == f"bytes */{have}":
            return  # nothing lies beyond what we have: an earlier run was stopped just before the end
        if error.code == 416:
            mark.unlink(missing_ok=True)  # without it the next attempt starts over
        raise
    with response:
        content = response.headers["Content-Range"] or ""
        if response.status == 206 and not (content.startswith(f"bytes {have}-") and _version(response) in ("", version)):
            mark.unlink(missing_ok=True)  # a 206 need not repeat the version, but must not have another
            raise ConnectionError("the server answered with another part of the file than asked for")
        if response.status != 206:
            bar.update(-have)
            have = 0
            partial.parent.mkdir(parents=True, exist_ok=True)
            partial.unlink(missing_ok=True)
            write_text(mark, _version(response))
        length = response.headers["Content-Length"]
        with open(partial, "ab") as file:
            while chunk := _read(response):
                bar.update(file.write(chunk))
        if length is not None and partial.stat().st_size != have + int(length):
            raise ConnectionError(f"the connection ended after {partial.stat().st_size} of {have + int(length)} bytes")


def _read(response: http.client.HTTPResponse) -> bytes:
    try:
        return response.read(CHUNK)
    except OSError as error:  # told apart from an error of writing, which another attempt would not mend
        raise ConnectionError(str(error)) from None


def _version(response: http.client.HTTPResponse) -> str:
    """What names this version of the file in `If-Range`: a strong ETag, or the date; a weak ETag cannot serve."""
    etag = response.headers["ETag"] or ""
    return etag if etag and not etag.startswith("W/") else (response.headers["Last-Modified"] or "")


def _with_retries(action: Callable[[], Any], address: str, mend: str, progress: Callable[[], int] = lambda: 0) -> Any:
    """The result of `action`, tried again with growing pauses while connections break; bytes that came reset the count."""
    failures, before = 0, progress()
    while True:
        try:
            return action()
        except BROKEN as error:
            failures, before = 1 if progress() > before else failures + 1, progress()
            reason = getattr(error, "reason", error)
            nameless = isinstance(reason, socket.gaierror) and not before  # without a network at all nobody wants to wait
            patience = 0 if isinstance(reason, ssl.SSLCertVerificationError) else 1 if nameless else len(PAUSES)
            if failures > patience:
                if isinstance(error, urllib.error.HTTPError):
                    raise InputError(f"{address}: the server fails (HTTP {error.code}); try again later") from None
                if isinstance(error, urllib.error.URLError):
                    raise InputError(f"no network: {address} cannot be reached ({reason}); {mend}") from None
                kept = f"run again, it goes on after {gigabytes(before)}"
                raise InputError(f"{address}: the connection keeps breaking ({error}); {kept}") from None
            time.sleep(PAUSES[failures - 1])
