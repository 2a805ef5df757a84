"""The geometric features of a checkpoint: its frozen PointNet (paper, section 4.1), or those of another class."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from cavin_pyro.config.commands import DEFAULT_CHECKPOINT
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import Config, construct
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.models.networks.pointnet import PointNet
from cavin_pyro.storage.checkpoint import Checkpoint, find_checkpoint, load_checkpoint

POINTNET = "cavin_pyro.models.networks.pointnet.PointNet"


def check_fit(model: Model, geometry: Geometry, objects: int | None = None) -> None:
    """Check that a model takes these features, and says that it is trained on scenes of up to `objects`.

    Raises:
        UserError: it does not.
    """
    name, features = type(geometry).__name__, geometry.feature_dimension
    wanted = model.dynamics.geometry
    if wanted is not None and not isinstance(geometry, wanted):
        raise UserError(
            f"{type(model.dynamics).__name__} reads the features of {wanted.__name__}, not of {name}: "
            f"pass geometry={wanted.__name__.lower()}"
        )
    if model.feature_dimension != features:
        raise UserError(f"model.feature_dimension={model.feature_dimension}, but the {name}'s features have {features}")
    if objects is not None and model.maximum_objects < objects:
        raise UserError(
            f"model.maximum_objects={model.maximum_objects}, but datasets have room for {objects}: "
            f"pass model.maximum_objects={objects}"
        )


def chosen_geometry(config: Config) -> tuple[Geometry, dict[str, Any]]:
    """The geometric features that the options of a training name, and their provenance.

    Raises:
        UserError: they cannot be built, or there is no PointNet where `pointnet` says, or it names one for nothing.
    """
    if config["geometry"].get("_target_") != POINTNET:
        if config["pointnet"] != DEFAULT_CHECKPOINT:
            raise UserError(f"pointnet={config['pointnet']} is of geometry=pointnet: add that, or leave pointnet")
        return _frozen(construct(config["geometry"])), {}
    path = find_checkpoint(config["pointnet"])
    return load_pointnet(path), pointnet_provenance(path)


def pointnet_provenance(path: Path) -> dict[str, Any]:
    """What a checkpoint says of where its PointNet comes from.

    Raises:
        UserError: the file cannot be used.
    """
    trained_before = load_checkpoint(path).provenance
    return {"pointnet": trained_before.get("pointnet", trained_before)}


def part_name(geometry: Geometry) -> str:
    """The name of its part of a checkpoint."""
    return "pointnet" if isinstance(geometry, PointNet) else "geometry"


def geometry_of(checkpoint: Checkpoint, where: str | Path) -> Geometry:
    """The geometric features within a checkpoint.

    Raises:
        UserError: there are none.
    """
    section = checkpoint.config.get("geometry") or {}
    if section.get("_target_", POINTNET) == POINTNET:
        return pointnet_of(checkpoint, where)
    geometry = _frozen(construct(section))
    checkpoint.load_into(part_name(geometry), geometry, where)
    return geometry


def load_pointnet(path: str | Path) -> PointNet:
    """The frozen PointNet of a pretraining run or of a whole checkpoint.

    Raises:
        UserError: the file cannot be used, or holds no PointNet.
    """
    return pointnet_of(load_checkpoint(path), path)


def pointnet_of(checkpoint: Checkpoint, where: str | Path) -> PointNet:
    """The frozen PointNet within a checkpoint.

    Raises:
        UserError: there is none.
    """
    weight = checkpoint.tensors.get("pointnet.feature.weight")
    if weight is None:
        raise UserError(f"checkpoint {where} holds no PointNet: give one that pretrain or train has written")
    pointnet = PointNet(feature_dimension=len(weight))
    checkpoint.load_into("pointnet", pointnet, where)
    return pointnet.requires_grad_(False).eval()


def _frozen(geometry: Any) -> Geometry:
    if not isinstance(geometry, Geometry):
        raise UserError(
            f"geometry {type(geometry).__name__} is no Geometry: derive it from cavin_pyro.models.networks.geometry"
        )
    return geometry.requires_grad_(False).eval()
