"""SHA-256 digests: of the weights in a checkpoint, and of the shipped checkpoints."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.files import atomic_write, file_digest

MANIFEST = "sha256sums.txt"  # in the folder of the shipped checkpoints, as `sha256sum --check` reads it


def tensors_digest(tensors: Mapping[str, Tensor]) -> str:
    """The SHA-256 of names, types, shapes and values, in the order of the names."""
    digest = hashlib.sha256()
    for name, value in sorted(tensors.items()):
        digest.update(f"{name} {value.dtype} {list(value.shape)} ".encode())
        digest.update(value.detach().cpu().contiguous().flatten().view(torch.uint8).numpy().tobytes())
    return digest.hexdigest()


def read_manifest(folder: Path) -> dict[str, str]:
    """The digests in a folder's manifest, by the files' paths in it; none without a manifest."""
    path = folder / MANIFEST
    if not path.is_file():
        return {}
    lines = [line.split(maxsplit=1) for line in path.read_text(encoding="utf-8").splitlines()]
    return {line[1].strip(): line[0] for line in lines if len(line) == 2}


def update_manifest(folder: Path) -> None:
    """Write the manifest of all checkpoints in a folder and in the folders below it."""
    files = sorted(folder.rglob("*.safetensors"))
    lines = [f"{file_digest(file)}  {file.relative_to(folder).as_posix()}\n" for file in files]
    with atomic_write(folder / MANIFEST) as temporary:
        temporary.write_text("".join(lines), encoding="utf-8")


def check_manifest(path: Path, folder: Path) -> None:
    """Check a file that the manifest of this folder names.

    Raises:
        UserError: it is not the file that was shipped.
    """
    if not path.resolve().is_relative_to(folder.resolve()):
        return
    name = path.resolve().relative_to(folder.resolve()).as_posix()
    wanted = read_manifest(folder).get(name)
    if wanted is not None and wanted != (found := file_digest(path)):
        raise UserError(
            f"checkpoint {path} is not the one that was shipped: its SHA-256 begins with {found[:12]}, that of "
            f"{folder / MANIFEST} with {wanted[:12]}: restore it, or give yours another name"
        )
