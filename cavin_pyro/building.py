"""From configuration to parts: models, priors, guides, objectives and planners, by their `_target_`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from pyro.nn import PyroModule

from cavin_pyro.checkpoint import Checkpoint, load_checkpoint
from cavin_pyro.errors import UserError
from models.pointnet import PointNet

Config = Mapping[str, Any] | DictConfig


def construct(config: Config, *arguments: Any, **keywords: Any) -> Any:
    """Build the part that a configuration names.

    Raises:
        UserError: there is no such class, it takes no such argument, or it refuses a value.
    """
    try:
        return instantiate(config, *arguments, **keywords)
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, ValueError):
            raise UserError(" ".join(str(cause).split())) from error
        raise UserError(f"{config.get('_target_')} cannot be built: {' '.join(str(cause).split())}") from error


def build_model(config: Config) -> PyroModule:
    """The model program with its priors, from the sections `model` and `prior`."""
    sizes = config["model"]
    priors = {
        name: construct(config["prior"], dimension=sizes[f"{kind}_dimension"])
        for name, kind in (("effect_prior", "effect"), ("motion_prior", "motion"))
    }
    return construct(sizes, **priors)


def build_guide(config: Config, model: PyroModule) -> PyroModule:
    """The guide program that goes with a model, from the section `guide`."""
    return construct(config["guide"], model)


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
