"""Downloads over HTTP: atomic, checked by checksum, and resumable."""

from __future__ import annotations

import http.client
import time
import urllib.error
import urllib.parse
import urllib.request
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.files import PARTIAL, file_digest, read_json, write_json
from cavin_pyro.storage.progress import progress_bar

TIMEOUT = 30.0  # seconds without an answer
CHUNK = 1 << 16  # bytes
LARGEST = 2_000_000_000  # bytes of a download, whatever length it declares; no archive here has a tenth of it
SLOWEST, PATIENCE = 2_000, 60.0  # bytes a second, on average after so many seconds


class Checksums:
    """SHA-256 of files by name: those in a lock file, which the first download of each writes.

    The publishers name no checksums. The first download is accepted if it is a complete archive whose contents pass
    every check; all later ones, from any mirror, must be the same bytes.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self._known: dict[str, str] = read_json(path) if path.exists() else {}
        if not isinstance(self._known, dict):
            raise UserError(f"{path} is damaged: it is no table of checksums; delete it")

    def check(self, file: Path) -> None:
        """Compare a file with the checksum that is known for its name.

        Raises:
            UserError: it differs; the file is deleted.
        """
        known, found = self._known.get(file.name), file_digest(file)
        if known not in (None, found):
            file.unlink()
            raise UserError(
                f"{file.name} has the wrong checksum: {found[:16]}..., not {str(known)[:16]}... as in {self.path}; "
                "run again, or delete that file if the publisher has changed it"
            )

    def record(self, file: Path) -> None:
        """Record the checksum of a file that has passed every check."""
        if file.name not in self._known:
            self._known[file.name] = file_digest(file)
            write_json(self.path, self._known)


def site(url: str) -> str:
    """An address below which files lie, without a slash at its end.

    Raises:
        UserError: it is no http or https address.
    """
    parts = urllib.parse.urlsplit(url)
    if parts.scheme not in ("http", "https") or not parts.netloc:
        raise UserError(f"--source must be an http or https address, not {url}")
    return url.rstrip("/")


def fetch(url: str, path: Path, checksums: Checksums) -> None:
    """Download to `path`, unless it is there already.

    Raises:
        UserError: no network, no such file, a connection that broke off, or a wrong checksum.
    """
    if not path.exists():
        path.parent.mkdir(parents=True, exist_ok=True)
        partial = path.with_name(path.name + PARTIAL)
        _receive(url, partial)
        partial.replace(path)
    checksums.check(path)


def _receive(url: str, partial: Path) -> None:
    begun = partial.stat().st_size if partial.exists() else 0
    request = urllib.request.Request(url, headers={"Range": f"bytes={begun}-"} if begun else {})
    try:
        with urllib.request.urlopen(request, timeout=TIMEOUT) as answer:
            begun = begun if answer.status == http.HTTPStatus.PARTIAL_CONTENT else 0
            _store(url, answer, partial, begun)
    except urllib.error.HTTPError as error:
        if error.code == http.HTTPStatus.REQUESTED_RANGE_NOT_SATISFIABLE and partial.exists():
            partial.unlink()  # it has all that there is, or of something else: begin anew
            _receive(url, partial)
            return
        raise UserError(f"{url} answers {error.code} {error.reason}: name a mirror with --source URL") from error
    except urllib.error.URLError as error:
        raise UserError(
            f"{_unreachable(url)} ({error.reason}): no network? or name a mirror with --source URL"
        ) from error
    except TimeoutError as error:
        raise UserError(f"{_unreachable(url)} (no answer in {TIMEOUT:g} s): run again to go on") from error
    except (http.client.HTTPException, ConnectionError) as error:
        raise UserError(f"{url} broke off ({type(error).__name__}): run again to go on") from error


def _store(url: str, answer: Any, partial: Path, begun: int) -> None:
    length = answer.headers.get("Content-Length")
    total = begun + int(length) if length and length.isdecimal() else None
    with (
        open(partial, "ab" if begun else "wb") as file,
        progress_bar(partial.name.removesuffix(PARTIAL), total=total or 0, initial=begun, unit="byte") as bar,
    ):
        _check_size(url, total or 0)
        since, received = time.monotonic(), 0
        while chunk := answer.read1(CHUNK):
            file.write(chunk)
            bar.update(len(chunk))
            received += len(chunk)
            _check_size(url, file.tell())
            spent = time.monotonic() - since
            if spent > PATIENCE and received < SLOWEST * spent:
                raise UserError(f"{url} sends under {SLOWEST} bytes a second: run again to go on, or name a mirror")
        held = file.tell()
    if total is not None and held != total:
        raise UserError(f"{url} broke off after {held} of {total} bytes: run again to go on")


def _check_size(url: str, size: int) -> None:
    if size > LARGEST:
        raise UserError(f"{url} is refused: it has over {LARGEST} bytes")


def _unreachable(url: str) -> str:
    return f"{urllib.parse.urlsplit(url).netloc} cannot be reached"
