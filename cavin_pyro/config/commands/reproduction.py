"""Options of the command reproduce."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from cavin_pyro.config.commands.device import DeviceOptions
from cavin_pyro.config.options import option


@dataclass
class ReproduceConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.reproduce`."""

    defaults: list[Any] = field(default_factory=lambda: ["_self_", "base"])
    scale: str = option(
        "smoke",
        "how large: smoke shows that everything runs (its rates mean nothing), small trains and evaluates little, "
        "medium is half a day on 2 cores, paper takes the paper's 500,000 transitions and 1,000 episodes per cell; "
        "minimal is for tests",
        choices="cavin_pyro.reproduction.sizes.SIZES",
    )
    methods: list[str] = option(
        ["cavin", "sectar", "cvae_mpc", "mpc"],
        "methods to train and evaluate; contact is CAVIN with networks that see contact",
        choices="cavin_pyro.reproduction.methods.METHODS",
    )
    planners: list[str] = option(
        ["paper", "ours"],
        "kinds of planners to evaluate: the paper's, and ours with its additions",
        choices="cavin_pyro.reproduction.cells.PLANNERS",
    )
    tasks: list[str] = option(
        ["clearing", "insertion", "crossing"], "tasks to evaluate", choices="cavin_pyro.reproduction.sizes.TASKS"
    )
    objects: list[int] = option(
        [1, 2, 3, 4, 5], "numbers of objects to evaluate with sparse rewards, at most those of the scale"
    )
    rewards: list[str] = option(
        ["dense", "sparse"], "rewards to evaluate", choices="cavin_pyro.reproduction.sizes.REWARDS"
    )
    episodes: int | None = option(
        None, "episodes per cell of the top row; by default the scale's. A finished run goes on to more", minimum=1
    )
    bottom_episodes: int | None = option(None, "episodes per cell of the bottom row; by default the scale's", minimum=1)
    first_scene: int | None = option(
        None,
        "seed of the first scene; the training seed at place i begins 1000 i later. By default the scale's",
        minimum=0,
    )
    models: str | None = option(
        None,
        "folder of trained models, METHOD-SEED.safetensors, such as checkpoints/reproduction; nothing is collected or "
        "trained then",
    )
    output: str | None = option(
        None, "folder for everything, where an unfinished run is resumed; by default one in runs/reproduce"
    )
    workers: int = option(2, "processes; the table does not depend on it", minimum=1)
    shard: str = option(
        "1/1",
        "i/n: the i-th of every n trainings and their episodes, so that n machines share the work; join their folders "
        "in one and run the command there without shard",
    )
    table: str | None = option(None, "a table of episodes, episodes.parquet, to draw and count; nothing is run then")
