"""The frozen PointNet of a checkpoint (paper, section 4.1), and its compatibility with a model."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro.config.errors import UserError
from cavin_pyro.storage.checkpoint import Checkpoint, load_checkpoint
from models.model import Model
from models.networks.pointnet import PointNet


def check_fit(model: Model, pointnet: PointNet, objects: int) -> None:
    """Check that a model takes these features and this number of objects.

    Raises:
        UserError: it does not.
    """
    features = pointnet.feature.out_features
    if model.feature_dimension != features:
        raise UserError(
            f"model.feature_dimension={model.feature_dimension}, but the PointNet's features have {features}"
        )
    if model.maximum_objects < objects:
        raise UserError(f"model.maximum_objects={model.maximum_objects}, but datasets have room for {objects}")


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
