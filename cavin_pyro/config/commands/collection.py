"""Options of the command collect."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from cavin_pyro.config.commands.device import LaunchOptions
from cavin_pyro.config.commands.world import WorldConfig, collection_world
from cavin_pyro.config.options import option, seed_option
from envs.workspace import OBJECT_SLOTS

POLICIES = ("heuristic", "model")


@dataclass
class CollectionOptions:
    """Options that determine the collected episodes, apart from their world."""

    seed: int = seed_option("root of all randomness")
    steps: int = option(10, "pushes per episode", minimum=1)
    intent_length: int = option(5, "pushes in a row that share a target object and a direction", minimum=1)
    perturbation_rate: float = option(0.3, "fraction of pushes with a perturbed start", minimum=0, maximum=1)
    policy: str = option(
        "heuristic",
        "what chooses the pushes; model samples effects from a checkpoint's prior, and for each takes the motion that "
        "f predicts nearest to the subgoal",
        choices=POLICIES,
    )
    checkpoint: str | None = option(
        None, "checkpoint for policy=model: a shipped one, or the path of one from train; by default contact"
    )
    motions: int = option(256, "motions sampled for each effect, for policy=model", minimum=1)
    minimum_objects: int = option(1, "objects on the table, at least", minimum=1)
    maximum_objects: int = option(
        OBJECT_SLOTS,
        f"objects on the table, at most; files are padded to this number, or to {OBJECT_SLOTS} if it is less",
    )
    episodes_per_shard: int = option(50, "episodes per file, the unit of resuming", minimum=1, maximum=10_000)


@dataclass
class CollectConfig(LaunchOptions, CollectionOptions):
    """Options of `python -m cavin_pyro.collect`."""

    defaults: list[Any] = field(default_factory=lambda: ["_self_", {"env/ranges": "paper"}, "base"])
    transitions: int = option(100_000, "pushes to collect, at least; whole files of episodes are written", minimum=1)
    output: str | None = option(
        None, "folder for the dataset, in which an unfinished one resumes; by default data/pushes, or beside it"
    )
    repair: bool = option(False, "collect missing or corrupt files again")
    env: WorldConfig = field(default_factory=collection_world)
