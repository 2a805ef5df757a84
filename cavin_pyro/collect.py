"""Collect pushing episodes: `python -m cavin_pyro.collect transitions=100000 output=DIR workers=2 seed=0`."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

from cavin_pyro.config.application import DictConfig, command


@command("collect")
def main(config: DictConfig) -> None:
    """Collect pushes by the heuristic policy into a dataset folder.

    In another world than the tabletop, episodes of its own policy. Resumes an interrupted run, and collects missing or
    damaged files again.
    """
    from cavin_pyro.data.collection import collect
    from cavin_pyro.storage.files import output_folder

    collection = _collection(config)
    with output_folder(config.output, "a dataset") as folder:
        metadata = collect(collection, folder, transitions=config.transitions, workers=config.workers)
        print(f"{metadata['transitions']} transitions in {metadata['episodes']} episodes, in {folder}")


def _collection(config: DictConfig) -> Any:
    """What determines the data, checked before anything is written."""
    from numpy.random import default_rng
    from omegaconf import OmegaConf

    from cavin_pyro.config.commands import CollectionOptions
    from cavin_pyro.config.errors import UserError, user_input
    from cavin_pyro.config.world import world_of
    from cavin_pyro.data.collection import collecting_world
    from cavin_pyro.data.episodes import WorldCollection

    given = {one.name: config[one.name] for one in fields(CollectionOptions)}
    world = world_of(config)
    if world is None:
        if config.minimum_objects > config.maximum_objects:
            raise UserError(f"minimum_objects must be at most maximum_objects={config.maximum_objects}")
        return replace(collecting_world(config.env), **given)
    own = {name: given.pop(name) for name in ("seed", "steps", "episodes_per_shard")}
    for name, value in given.items():
        if value != getattr(CollectionOptions, name):
            raise UserError(f"{name}={value} is of the tabletop, and not of {type(world).__name__}: leave it")
    with user_input("env"):
        world.policy(default_rng())
    section: Any = OmegaConf.to_container(config.world)
    return WorldCollection(section, **own)


if __name__ == "__main__":
    main()
