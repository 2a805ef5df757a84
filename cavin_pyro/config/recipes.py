"""What `quickstart` runs: the commands from an empty folder to a planner, by world and number of minutes.

Minutes are those of the tabletop on two idle cores; sizes are powers of them. docs/results.md has what comes out.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.composition import as_typed
from cavin_pyro.config.options import constructor_options, flat_options


class Recipe(NamedTuple):
    """Options as typed. sizes: of data and of training, in 10 and 20 minutes. tasks: one evaluation each."""

    collect: str
    train: str
    plan: str
    sizes: tuple[tuple[int, int], tuple[int, int]]
    tasks: tuple[str, ...] = ("",)


class Step(NamedTuple):
    """A command with its options, and the minutes that it takes."""

    command: str
    options: list[str]
    minutes: float


TRAINER = "trainer.batch_size=256 trainer.schedule=cosine trainer.validate_every=500"
FLOW = f"prior=flow trainer.learning_rate=1e-3 {TRAINER}"
TABLETOP = Recipe(
    collect="",
    train="geometry=outline dynamics=contact dynamics.equivariant=true scales=predicted prior=mixture "
    "objective=rollout trainer.reflect=true trainer.batches=bucketed trainer.matmul_precision=bfloat16 "
    f"trainer.learning_rate=2e-3 trainer.clip_norm=10000 windows.negative_fraction=0.5 {TRAINER}",
    plan="",
    sizes=((10_000, 20_000), (3_300, 7_000)),
    tasks=("task=clearing", "task=insertion", "task=crossing"),
)
WORLDS = {
    "pusht": Recipe(
        collect="env.criterion=none steps=60",
        train="dynamics=residual prior.width=64 prior.transforms=6 model.width=128 guide.width=128 "
        f"model.effect_dimension=8 model.motion_dimension=8 trainer.reflect=true {FLOW}",
        plan="planner.horizon=15 planner.shrinking_horizon=true planner.reward_at=subgoals planner.samples=2048 "
        "planner.optimizer=icem planner.optimizer.iterations=10 planner.optimizer.elite_fraction=0.03 "
        "planner.add=[perturbed_rollouts,{_target_:cavin_pyro.planning.additions.AnotherEffect,tolerance:6}]",
        sizes=((300_000, 900_000), (4_000, 9_000)),
    ),
    "maze": Recipe(
        collect="steps=100",
        train=f"model.width=64 guide.width=64 model.effect_dimension=4 model.motion_dimension=4 {FLOW}",
        plan="planner.horizon=60 planner.motion_horizon=first_segment planner.samples=4096",
        sizes=((50_000, 100_000), (3_000, 8_000)),
    ),
}
OWN = Recipe("", FLOW, "", ((20_000, 100_000), (3_000, 8_000)))


def steps_of(config: DictConfig, home: Path) -> Iterator[Step]:
    """The commands of `quickstart` in their order; each writes into a folder of `home`."""
    recipe, env = _of_world(config)
    minutes, seed, workers = int(config.minutes), f"seed={config.seed}", f"workers={config.workers}"
    transitions, steps = (round(ten * (twenty / ten) ** math.log2(minutes / 10)) for ten, twenty in recipe.sizes)
    checkpoint = f"checkpoint={home / 'train' / 'checkpoint.safetensors'}"

    def step(command: str, place: str, share: float, *options: str) -> Step:
        return Step(command, [*options, f"output={home / place}"], share * minutes)

    collect, train, plan = recipe.collect.split(), recipe.train.split(), recipe.plan.split()
    yield step("collect", "data", 0.2, *env, *collect, f"transitions={transitions}", seed, workers)
    yield step("train", "train", 0.7, *train, f"trainer.steps={steps}", f"data={home / 'data'}", seed)
    for task in recipe.tasks:
        planned, name = [*env, *plan, *task.split(), checkpoint, "seed=20000"], task.partition("=")[2]
        share = 0.08 / len(recipe.tasks)
        yield step("evaluate", f"evaluate{name and '-'}{name}", share, *planned, f"episodes={config.episodes}", workers)
    yield step("plan", "episode", 0.02, *planned)


def _of_world(config: DictConfig) -> tuple[Recipe, list[str]]:
    """The recipe of the chosen world, and the options that choose it, where they differ from its usual ones."""
    world: Any = OmegaConf.to_container(config.world)
    if not (target := world.pop("_target_")):
        return TABLETOP, []
    name, usual = target.split(".")[2] if target.startswith("cavin_pyro.envs.") else "", constructor_options(target)
    options = [f"env={name}" if name else f"env._target_={target}"]
    for option, value in world.items():
        if option not in usual or usual[option].default != value:
            options += [f"env.{key}={as_typed(one)}" for key, one in flat_options({option: value}).items()]
    return WORLDS.get(name, OWN), options
