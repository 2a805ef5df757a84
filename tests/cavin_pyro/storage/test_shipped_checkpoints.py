"""The checkpoint that plan and evaluate load unless told otherwise, and the others beside it."""

from __future__ import annotations

import hashlib
from pathlib import Path

import pytest

from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.checkpoint import load, shipped_folder
from cavin_pyro.storage.digests import tensors_digest
from cavin_pyro.storage.files import file_digest

SHIPPED = sorted(shipped_folder().glob("*.safetensors"))
WEIGHTS = "af028cebae499b1487a6d1aa5ee81ac86d4f51c9ffcb41d04f39ffa83f25be5b"  # of all their digests and names


def test_every_shipped_checkpoint_is_in_the_manifest_and_keeps_its_weights() -> None:
    files = {path.relative_to(shipped_folder()).as_posix(): path for path in shipped_folder().rglob("*.safetensors")}
    assert len(files) == 32
    sums = {f"{file_digest(path)}  {name}" for name, path in files.items()}
    assert set((shipped_folder() / "sha256sums.txt").read_text().splitlines()) == sums
    digests = [f"{tensors_digest(load(path).tensors)}  {name}\n" for name, path in sorted(files.items())]
    assert hashlib.sha256("".join(digests).encode()).hexdigest() == WEIGHTS


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_checkpoint_builds_with_its_own_configuration_and_holds_its_provenance(path: Path) -> None:
    assert path.stat().st_size <= 4_000_000
    checkpoint = load(path)
    provenance = checkpoint.provenance
    for part in filter(None, (checkpoint.model, checkpoint.guide, checkpoint.geometry)):  # Push-T has no geometry
        assert not any(parameter.requires_grad for parameter in part.parameters())
    assert sum(data["transitions"] for data in provenance["data"]) >= 100_000
    assert {"command", "date", "packages", "revision", "step", "metrics"} <= set(provenance)
    assert ("pointnet" in provenance) == isinstance(checkpoint.geometry, PointNet)  # which alone is trained before
