"""Files: atomic writes, so that each is complete or absent, JSON, digests, and folders for results."""

from __future__ import annotations

import hashlib
import json
import os
import time
import uuid
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.lock import LOCK_NAME, folder_lock

CONFIG_NAME = "config.yaml"  # the options of a run
DATA_NAME = "data.json"  # which data a training began with
HELD = {"a run": CONFIG_NAME, "a dataset": "metadata.json"}  # by what a folder for results shows what it holds
PARTIAL = ".partial"  # in the names of files that are being written
OURS = ".cavin-"  # in the names of those that `atomic_write` makes, which alone are cleared away


@contextmanager
def atomic_write(path: Path) -> Iterator[Path]:
    """Yield a temporary path beside `path`; rename it to `path` at the end, or delete it on an error."""
    temporary = path.with_name(f".{path.stem}{OURS}{uuid.uuid4().hex[:8]}{PARTIAL}{path.suffix}")
    try:
        yield temporary
        with open(temporary, "rb") as written:
            os.fsync(written.fileno())
        os.replace(temporary, path)
    except OSError as error:
        if error.errno is not None and error.filename in (None, str(temporary)):
            error.filename = str(path)  # the error of a full disk names no file
        raise
    finally:
        temporary.unlink(missing_ok=True)


def write_json(path: Path, content: Any) -> None:
    """Write JSON atomically."""
    with atomic_write(path) as temporary:
        temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def read_json(path: Path) -> Any:
    """Read JSON; a `UserError` if the file cannot be read or holds something else."""
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path} cannot be read: {error.strerror}") from error
    except (ValueError, RecursionError) as error:
        raise UserError(
            f"{path} is damaged: it is not JSON ({error}); delete it and run what wrote it again"
        ) from error


def file_digest(path: Path) -> str:
    """The SHA-256 of a file, read piece by piece: hexadecimal digits."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


@contextmanager
def output_folder(path: str | Path, holds: str = "a run") -> Iterator[Path]:
    """Hold a folder for results: it exists, is writable and is locked, and what a killed run left half-written is gone.

    A folder that was made for this and is still empty at the end is deleted, and so is one that holds nothing but its
    options when the command fails: a command that is refused, or that the memory does not allow, leaves nothing. A
    `UserError` if the folder cannot be written, another process writes into it, or it `holds` something else.
    """
    folder = Path(path)
    with ExitStack() as held:
        try:
            made = [one for one in (folder, *folder.parents) if not one.exists()]  # the deepest first
            folder.mkdir(parents=True, exist_ok=True)
            held.callback(_delete_empty, made)
            held.enter_context(folder_lock(folder))
            clear_abandoned(folder)
        except (OSError, ValueError) as error:  # the latter of a name with a null byte
            why = getattr(error, "strerror", error)
            raise UserError(f"output folder {folder} cannot be written ({why}): choose another output=DIR") from error
        if other := [one for one, name in HELD.items() if one != holds and (folder / name).exists()]:
            raise UserError(f"{folder} holds {other[0]}, not {holds}: choose another output=DIR")
        try:
            yield folder
        except BaseException:
            if folder in made and folder.is_dir() and holds_no_result(folder):
                for name in (CONFIG_NAME, DATA_NAME):
                    (folder / name).unlink(missing_ok=True)
            raise


def holds_no_result(folder: Path) -> bool:
    """Whether a run in a folder, if there is one, failed before its first result."""
    return {one.name for one in folder.iterdir()} <= {CONFIG_NAME, DATA_NAME, LOCK_NAME}


def clear_abandoned(folder: Path, *, older_than: float = 0.0) -> None:
    """Delete what a killed run left half-written in a folder. Nobody else may write there now.

    `older_than`: seconds; leave younger files, for a folder that others may write into.
    """
    for path in folder.glob(f".*{OURS}{'[0-9a-f]' * 8}{PARTIAL}*"):  # users' own partial downloads may lie there too
        with suppress(FileNotFoundError):
            if path.is_file() and time.time() - path.stat().st_mtime >= older_than:
                path.unlink()


def _delete_empty(folders: list[Path]) -> None:
    with suppress(OSError):  # the first that is not empty
        for folder in folders:
            folder.rmdir()
