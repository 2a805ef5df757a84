"""Install a publisher's archives as a folder of assets, atomically."""

from __future__ import annotations

import shutil
from contextlib import suppress
from pathlib import Path
from typing import Protocol

from cavin_pyro.config.errors import UserError
from cavin_pyro.fetching.archive import Archive
from cavin_pyro.fetching.download import Checksums, fetch
from cavin_pyro.fetching.meshes import MissingExtraError
from cavin_pyro.storage.files import PARTIAL
from cavin_pyro.storage.progress import progress_bar

DONE = ".done"  # a folder with an empty file for every piece that is finished


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

    def make(self, piece: str, archive: Archive, folder: Path) -> None:
        """Write a piece's files into the folder.

        Raises:
            UserError: the archive does not hold what it should.
        """

    def verify(self, folder: Path) -> str:
        """Check a finished folder, and say in a line what it holds.

        Raises:
            UserError: something is missing or is not as published.
        """


def install(kind: Kind, to: Path, site: str) -> str:
    """Make the folder `to / kind.name`, piece by piece in a folder beside it that takes its place at the end.

    Returns:
        A line on what the folder holds.

    Raises:
        UserError: a download or a check failed, or the disk refused. What was finished is kept for the next run.
    """
    target, staging = to / kind.name, to / f".{kind.name}{PARTIAL}"
    if target.exists():
        try:
            return f"{target} is there already: {kind.verify(target)}"
        except UserError as error:
            raise UserError(f"{error}; move {target} away to make it anew") from error
    try:
        _build(kind, to, site, staging)
        line = kind.verify(staging)
        shutil.rmtree(staging / DONE)
        staging.replace(target)
        shutil.rmtree(_downloads(kind, to), ignore_errors=True)
    except OSError as error:
        raise UserError(
            f"{error.filename or to} cannot be written ({error.strerror}): free some space or choose another --to DIR"
        ) from error
    finally:
        _tidy(staging / DONE, staging, _downloads(kind, to), to)
    return f"{target}: {line}"


def _build(kind: Kind, to: Path, site: str, staging: Path) -> None:
    staging.mkdir(parents=True, exist_ok=True)
    checksums = Checksums(to / f"{kind.name}.lock.json")
    done = staging / DONE
    done.mkdir(exist_ok=True)
    finished = [piece for piece in kind.pieces if (done / piece).exists()]
    with progress_bar(kind.name, total=len(kind.pieces), initial=len(finished), unit="piece") as bar:
        for piece, path in kind.pieces.items():
            if piece not in finished:
                bar.set_postfix_str(piece)
                file = _downloads(kind, to) / Path(path).name
                fetch(f"{site}/{path}", file, checksums)
                try:
                    kind.make(piece, Archive(file, kind.wanted), staging)
                except MissingExtraError:
                    raise
                except UserError:
                    file.unlink()  # so that the next run fetches it anew
                    raise
                checksums.record(file)
                (done / piece).touch()
                bar.update()


def _tidy(*folders: Path) -> None:
    """Delete empty folders, so that a run that fails at once leaves nothing."""
    for folder in folders:
        with suppress(OSError):
            folder.rmdir()


def _downloads(kind: Kind, to: Path) -> Path:
    return to / f".{kind.name}.downloads"
