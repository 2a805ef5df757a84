"""The checkpoint that plan and evaluate load unless told otherwise, and the others beside it."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.storage.checkpoint import default_checkpoint, load_checkpoint
from cavin_pyro.storage.geometry import geometry_of, part_name

SHIPPED = sorted(default_checkpoint().parent.glob("*.safetensors"))


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_checkpoint_is_small_and_builds_with_its_own_configuration(path: Path) -> None:
    assert path.stat().st_size <= 3_000_000
    checkpoint = load_checkpoint(path)
    model = build_model(checkpoint.config)
    checkpoint.load_into("model", model, path)
    guide = build_guide(checkpoint.config, model)
    checkpoint.load_into("guide", guide, path)
    assert not any(parameter.requires_grad for parameter in geometry_of(checkpoint, path).parameters())


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_a_shipped_checkpoint_holds_its_provenance(path: Path) -> None:
    checkpoint = load_checkpoint(path)
    provenance = checkpoint.provenance
    assert sum(data["transitions"] for data in provenance["data"]) >= 100_000
    assert {"command", "date", "packages", "revision", "step", "metrics"} <= set(provenance)
    # Only a PointNet has been trained before.
    assert ("pointnet" in provenance) == (part_name(geometry_of(checkpoint, path)) == "pointnet")
    assert provenance["command"].startswith("python -m cavin_pyro.train ")
