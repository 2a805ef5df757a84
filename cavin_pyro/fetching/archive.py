"""Files of an untrusted archive: each is read into memory, none is unpacked onto the disk."""

from __future__ import annotations

import gzip
import tarfile
import zlib
from pathlib import Path, PurePosixPath

from cavin_pyro.config.errors import UserError

LARGEST = 200_000_000  # bytes of one file; no mesh here has a tenth of it
LARGEST_WHOLE = 2_000_000_000  # bytes of all files


class Archive:
    """All files of a gzipped tar, by their paths without the folder on top.

    Raises:
        UserError: it is damaged, or a member would lie outside the archive's own folder or is too large.
    """

    def __init__(self, path: Path, wanted: tuple[str, ...]) -> None:
        self.path = path
        self._files: dict[str, bytes] = {}
        try:
            self._read_to_the_end()
            with tarfile.open(path, "r:gz") as tar:
                for member in tar:
                    self._take(tar, member, wanted)
        except (tarfile.TarError, EOFError, zlib.error, OSError) as error:
            raise UserError(f"the archive {path.name} is broken ({error}): run again to fetch it anew") from error

    @property
    def names(self) -> tuple[str, ...]:
        """Paths of the files that were wanted."""
        return tuple(self._files)

    def read(self, name: str) -> bytes:
        """The bytes of a file.

        Raises:
            UserError: there is no such file.
        """
        if name not in self._files:
            raise UserError(f"the archive {self.path.name} holds no {name}: it is another archive")
        return self._files[name]

    def _read_to_the_end(self) -> None:
        """A tar ends before its gzip's checksum does: without this, changed bytes would go unnoticed."""
        held = 0
        with gzip.open(self.path) as whole:
            while chunk := whole.read(1 << 20):
                held += len(chunk)
                if held > LARGEST_WHOLE:
                    raise UserError(
                        f"the archive {self.path.name} is refused: it unpacks to over {LARGEST_WHOLE} bytes"
                    )

    def _take(self, tar: tarfile.TarFile, member: tarfile.TarInfo, wanted: tuple[str, ...]) -> None:
        path = PurePosixPath(member.name)
        if path.is_absolute() or ".." in path.parts or "\\" in member.name:
            raise UserError(f"the archive {self.path.name} is refused: {member.name!r} would lie outside it")
        name = "/".join(path.parts[1:])
        if not member.isfile() or not name.endswith(wanted):
            return
        if member.size > LARGEST:
            raise UserError(f"the archive {self.path.name} is refused: {member.name} has {member.size} bytes")
        content = tar.extractfile(member)
        assert content is not None  # isfile
        self._files[name] = content.read()
