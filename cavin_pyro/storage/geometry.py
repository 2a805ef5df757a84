"""The geometric features of a training, and whether they fit its model."""

from __future__ import annotations

from typing import Any

from cavin_pyro.config.commands import DEFAULT_CHECKPOINT
from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.parts import PARTS, Config, construct
from cavin_pyro.models.model import Model
from cavin_pyro.models.networks.geometry import Geometry
from cavin_pyro.storage.checkpoint import POINTNET, load


@user_input(*PARTS)
def check_fit(
    model: Model, geometry: Geometry | None, objects: int | None = None, *, features: int | None = None
) -> None:
    """Check that a model takes these features, and says that it is trained on scenes of up to `objects`.

    `geometry`: None in other worlds than the tabletop, whose states have `features` numbers of their own.
    """
    name = "world" if geometry is None else type(geometry).__name__
    wanted = model.dynamics.geometry
    if wanted is not None and not isinstance(geometry, wanted):
        raise UserError(
            f"{type(model.dynamics).__name__} reads the features of {wanted.__name__}, not of {name}: "
            f"pass geometry={wanted.__name__.lower()}"
        )
    features = features if geometry is None else geometry.feature_dimension
    if features is not None and model.feature_dimension != features:
        raise UserError(f"model.feature_dimension={model.feature_dimension}, but the {name}'s features have {features}")
    if objects is not None and model.maximum_objects < objects:
        raise UserError(
            f"model.maximum_objects={model.maximum_objects}, but datasets have room for {objects}: "
            f"pass model.maximum_objects={objects}"
        )


def chosen_geometry(config: Config) -> tuple[Geometry, dict[str, Any]]:
    """The geometric features that the options of a training name, and their provenance."""
    if config["geometry"].get("_target_") != POINTNET:
        if config["pointnet"] != DEFAULT_CHECKPOINT:
            raise UserError(f"pointnet={config['pointnet']} is of geometry=pointnet: add that, or leave pointnet")
        return construct(config["geometry"], kind=Geometry).requires_grad_(False).eval(), {}
    trained = load(config["pointnet"])
    return trained.pointnet, {"pointnet": trained.provenance.get("pointnet", trained.provenance)}
