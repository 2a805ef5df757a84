"""SHA-256 digests: of the weights in a checkpoint, and of the shipped checkpoints."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.files import file_digest

MANIFEST = "sha256sums.txt"  # of the shipped checkpoints: `sha256sum *.safetensors */*.safetensors` in their folder


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
    lines = path.read_text(encoding="utf-8").splitlines() if path.is_file() else []
    return {name.strip(): digest for digest, _, name in (line.partition(" ") for line in lines)}


def check_manifest(path: Path, folder: Path) -> None:
    """Check that a file that the manifest of this folder names is the one that was shipped, or a `UserError`."""
    if not path.resolve().is_relative_to(folder.resolve()):
        return
    wanted = read_manifest(folder).get(path.resolve().relative_to(folder.resolve()).as_posix())
    if wanted is not None and wanted != (found := file_digest(path)):
        raise UserError(
            f"checkpoint {path} is not the one that was shipped: its SHA-256 begins with {found[:12]}, that of "
            f"{folder / MANIFEST} with {wanted[:12]}: restore it, or give yours another name"
        )
