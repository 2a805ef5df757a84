"""Training that goes on from a checkpoint, in whole or in some of its parts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from torch import nn

from cavin_pyro.config.errors import UserError
from cavin_pyro.data.features import geometry_fingerprint
from cavin_pyro.storage.checkpoint import find_checkpoint, load_checkpoint
from cavin_pyro.storage.digests import file_digest
from cavin_pyro.storage.geometry import geometry_of
from guides.guide import Guide
from models.model import Model
from models.networks.geometry import Geometry


def start_from(
    name: str, model: Model, guide: Guide, geometry: Geometry, trained: Sequence[str] = ()
) -> dict[str, Any]:
    """Copy the weights of a checkpoint into model and guide, which must be of its architecture.

    Args:
        name: of a shipped checkpoint, or the path of one that train has written. trained: see `train_only`.

    Returns:
        Its digest and provenance, for that of the new one. What a calibration has found stays true where f alone is
        trained: neither the codes' priors nor what a guide reads depends on f.

    Raises:
        UserError: there is no such file, it holds other parts, or features of another geometry.
    """
    path = find_checkpoint(name)
    checkpoint = load_checkpoint(path)
    checkpoint.load_into("model", model, path)
    checkpoint.load_into("guide", guide, path)
    if geometry_fingerprint(geometry_of(checkpoint, path)) != geometry_fingerprint(geometry):
        raise UserError(f"checkpoint {path} was trained with other geometric features: give its geometry= or pointnet=")
    about = checkpoint.provenance
    kept = {name: about[name] for name in ("calibrated",) if name in about and list(trained) == ["dynamics"]}
    return {**kept, "initial": {"sha256": file_digest(path), "provenance": about}}


def parts_of(model: Model, guide: Guide) -> dict[str, nn.Module]:
    """The parts that training can change or leave: those of the model that have weights, and the guide."""
    parts = {**dict(model.named_children()), "guide": guide}
    return {name: part for name, part in parts.items() if any(True for _ in part.parameters())}


def train_only(names: Sequence[str], model: Model, guide: Guide) -> None:
    """Leave the weights of all other parts as they are; no names stand for all parts.

    Raises:
        UserError: a name is of no part.
    """
    parts = parts_of(model, guide)
    for name in names:
        if name not in parts:
            raise UserError(f"trained has {name!r}, which is no part of this model: choose from {', '.join(parts)}")
    for name, part in parts.items():
        part.requires_grad_(not names or name in names)
