"""From configuration to parts: models, priors, guides, objectives and planners, by their `_target_`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from hydra.errors import InstantiationException
from hydra.utils import instantiate
from omegaconf import DictConfig
from pyro.infer import ELBO
from pyro.nn import PyroModule

from cavin_pyro.checkpoint import Checkpoint, load_checkpoint
from cavin_pyro.errors import UserError, at_least
from models.pointnet import PointNet

Config = Mapping[str, Any] | DictConfig


def construct(config: Config, *arguments: Any, **keywords: Any) -> Any:
    """Build the part that a configuration names.

    Raises:
        UserError: there is no such class, it takes no such argument, or it refuses a value.
    """
    if not config.get("_target_"):
        raise UserError(f"a part has no _target_, the class to build it from: {dict(config)}")
    try:
        return instantiate(config, *arguments, **keywords)
    except InstantiationException as error:
        cause = error.__cause__ or error
        if isinstance(cause, ValueError):
            raise UserError(" ".join(str(cause).split())) from error
        raise UserError(f"{config.get('_target_')} cannot be built: {' '.join(str(cause).split())}") from error


def check_sizes(section: str, config: Config) -> None:
    """Make sure that every whole number of a section is at least 1.

    Raises:
        UserError: one is not.
    """
    for name, value in config.items():
        if type(value) is int:
            at_least(f"{section}.{name!s}", value, 1)


def build_model(config: Config) -> PyroModule:
    """The model program with its priors, from the sections `model` and `prior`."""
    sizes = config["model"]
    check_sizes("model", sizes)
    try:
        priors = {
            name: construct(config["prior"], dimension=sizes[f"{kind}_dimension"])
            for name, kind in (("effect_prior", "effect"), ("motion_prior", "motion"))
        }
    except KeyError as error:
        raise UserError(f"the configuration of the model lacks {error}") from error
    return construct(sizes, **priors)


def build_guide(config: Config, model: PyroModule) -> PyroModule:
    """The guide program that goes with a model, from the section `guide`."""
    check_sizes("guide", config["guide"])
    return construct(config["guide"], model)


def build_objective(config: Config) -> ELBO:
    """What training minimises, from the section `objective`."""
    check_sizes("objective", config["objective"])
    return construct(config["objective"])


def check_fit(model: PyroModule, pointnet: PointNet, objects: int) -> None:
    """Make sure that a model takes these features of so many objects.

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
