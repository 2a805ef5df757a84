"""Install a publisher's archives as a folder of assets: downloads by pooch, and the folder appears when it is whole."""

from __future__ import annotations

import shutil
import tarfile
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.files import PARTIAL, file_digest, output_folder, read_json, write_json
from cavin_pyro.storage.progress import progress_bar

LARGEST = 200_000_000  # bytes of one file of an archive; no mesh here has a tenth of it
TIMEOUT = 30.0  # seconds without an answer

Files = dict[str, bytes]


class Kind(Protocol):
    """One kind of assets.

    Attributes:
        name: of the kind and of its folder. site: the publisher's address.
        pieces: what is made, by name; each from one archive, whose path on the site this maps it to.
        wanted: endings of the files to be taken from an archive.
    """

    name: str
    site: str
    pieces: dict[str, str]
    wanted: tuple[str, ...]

    def make(self, piece: str, files: Files, folder: Path) -> None:
        """Write a piece into the folder, from its archive's files; a UserError: they are not what was meant."""

    def verify(self, folder: Path) -> str:
        """A line on what a finished folder holds; a UserError: something is missing or not as published."""


def install(kind: Kind, to: Path, source: str | None = None) -> str:
    """Make the folder `to / kind.name`; a rerun keeps finished pieces and archives that were downloaded.

    The publishers name no checksums: SHA-256 of each archive is kept in `to / NAME.lock.json` once it has passed every
    check, and all later downloads, from any mirror, must be the same bytes.

    `source`: a mirror of the publisher's site. Returns a line on what the folder holds. A UserError: a download or a
    check failed, or the folder cannot be written.
    """
    site = source or kind.site
    if urlsplit(site).scheme not in ("http", "https"):
        raise UserError(f"--source must be an http or https address, not {site}")
    target, staging, downloads = to / kind.name, to / f".{kind.name}{PARTIAL}", to / f".{kind.name}.downloads"
    if target.exists():
        try:
            return f"{target} is there already: {kind.verify(target)}"
        except UserError as error:
            raise UserError(f"{error}; move {target} away to make it anew") from error
    with output_folder(to):
        lock = to / f"{kind.name}.lock.json"
        known = read_json(lock) if lock.exists() else {}
        finished = staging / "finished.json"
        done = read_json(finished) if finished.exists() else []
        try:
            staging.mkdir(exist_ok=True)
            for piece, path in kind.pieces.items():
                if piece in done:
                    continue
                archive = _download(f"{site.rstrip('/')}/{path}", downloads, known.get(Path(path).name), lock)
                try:
                    kind.make(piece, _read_archive(archive, kind.wanted), staging)
                except UserError:
                    archive.unlink()  # so that the next run fetches it anew
                    raise
                if archive.name not in known:
                    write_json(lock, known := {**known, archive.name: file_digest(archive)})
                write_json(finished, done := [*done, piece])
            line = kind.verify(staging)
            finished.unlink()
            staging.replace(target)
            shutil.rmtree(downloads)
        except ImportError as error:
            raise UserError(f"{error}: pip install 'cavin-pyro[assets]', then run again") from error
        finally:
            for folder in (staging, downloads):
                with suppress(OSError):  # it is gone, or holds what the next run uses
                    folder.rmdir()
    return f"{target}: {line}"


def _download(url: str, folder: Path, digest: str | None, lock: Path) -> Path:
    """The path of a file in the folder, downloaded unless it is there; `digest`: its SHA-256 as in `lock`, if known."""
    import pooch

    name = url.rpartition("/")[2]
    pooch.get_logger().setLevel("WARNING")
    try:
        with progress_bar(name, total=0, unit="byte") as bar:
            downloader = pooch.HTTPDownloader(progressbar=bar, timeout=TIMEOUT)
            return Path(pooch.retrieve(url, digest, fname=name, path=folder, downloader=downloader))
    except ValueError as error:
        raise UserError(
            f"{name} has the wrong checksum, not the one in {lock}: run again, or delete that file if the publisher "
            "has changed it"
        ) from error
    except OSError as error:
        if error.errno is not None:  # of the disk, not of the network
            raise
        answer = getattr(getattr(error, "response", None), "status_code", None)
        what = f"answers {answer}" if answer else f"cannot be reached ({type(error).__name__})"
        raise UserError(f"{url} {what}: run again, or name a mirror with --source URL") from error


def _read_archive(path: Path, wanted: tuple[str, ...]) -> Files:
    """The wanted files of an untrusted gzipped tar by their paths, read into memory: none is unpacked onto the disk."""
    files: Files = {}
    try:
        with tarfile.open(path, "r:gz") as tar:
            for member in tar:
                name = member.name.partition("/")[2]
                if member.isfile() and name.endswith(wanted):
                    if member.size > LARGEST:
                        raise UserError(f"the archive {path.name} is refused: {name} has {member.size} bytes")
                    content = tar.extractfile(member)
                    assert content is not None  # isfile
                    files[name] = content.read()
    except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
        raise UserError(f"the archive {path.name} is broken ({error}): run again to fetch it anew") from error
    return files


def take(files: Files, name: str) -> bytes:
    """The bytes of a file of an archive; a UserError: there is no such file."""
    if name not in files:
        raise UserError(f"the archive holds no {name}: it is another archive")
    return files[name]
