"""The world for the collection of random pushes."""

from __future__ import annotations

from omegaconf import DictConfig

from cavin_pyro.config.commands.world import WorldConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.own_parts import own_class, plain
from cavin_pyro.config.world import check_world, object_ranges
from cavin_pyro.data.collection import CollectionConfig


def collecting_world(env: DictConfig) -> CollectionConfig:
    """The configuration of a collection in the world of `env.*`, with default options.

    Raises:
        UserError: as `check_world` and `object_ranges`, or another robot than the stick.
    """
    check_world(env)
    if env.robot != WorldConfig.robot:
        robot = own_class(env.robot)
        raise UserError(
            f"random pushes are made with env.robot=stick, not {robot}: its pushes are equivalent and faster"
        )
    return CollectionConfig(
        ranges=object_ranges(env),
        object_set=plain(env.objects),
        assets=env.assets,
        camera=plain(env.camera),
        segmentation=plain(env.segmentation),
    )
