"""Every world that the options `env.*` can select, in every task, under Gymnasium's checker.

The choices are read from `cavin_pyro.config.world`, so that a new robot, object set, camera or segmentation is tried
without a line here. Every two choices meet in some world; `CAVIN_EVERY_WORLD=1` tries all combinations. Those with an
arm are tried by `make soak`; tests/envs/test_robots.py has arms in `make test`, too.

Meshes are looked for in `CAVIN_ASSETS`, by default `../shared/assets` beside the repository.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import combinations, product
from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cavin_pyro.config.commands.world import WorldConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import options
from cavin_pyro.evaluation.factory import make_runner
from envs.pushing import PushingEnv
from envs.tasks import TASKS
from tests.real_assets import REAL_ASSETS

CHOICES = {one.name: one.about.names for one in options(WorldConfig) if one.about.names}

World = dict[str, str]


def every_world() -> list[World]:
    choices = {"task": tuple(TASKS), **{f"env.{name}": tuple(valid) for name, valid in CHOICES.items()}}
    return [dict(zip(choices, values, strict=True)) for values in product(*choices.values())]


def pairs(world: World) -> set[tuple[tuple[str, str], ...]]:
    return set(combinations(world.items(), 2))


def covering(worlds: list[World]) -> list[World]:
    """A few worlds in which every two choices meet: each is the one with most pairs that have not met before."""
    missing, chosen = set().union(*map(pairs, worlds)), []
    while missing:
        chosen.append(max(worlds, key=lambda world: len(pairs(world) & missing)))
        missing -= pairs(chosen[-1])
    return chosen


WORLDS = every_world() if os.environ.get("CAVIN_EVERY_WORLD") else covering(every_world())


@pytest.fixture(
    params=[
        pytest.param(
            world, id="-".join(world.values()), marks=[] if world["env.robot"] == "stick" else pytest.mark.soak
        )
        for world in WORLDS
    ]
)
def env(request: pytest.FixtureRequest, configure: Any) -> Iterator[PushingEnv]:
    choices = [f"{name}={value}" for name, value in request.param.items()]
    assets = [f"env.assets={REAL_ASSETS}"] if REAL_ASSETS.is_dir() else []
    try:
        runner = make_runner(configure("planner=random", *choices, *assets), render=True)
    except UserError as error:
        if "assets" in str(error) and not assets:
            pytest.skip(f"no meshes at {REAL_ASSETS}, set CAVIN_ASSETS to their folder: {error}")
        raise
    yield runner.env
    runner.env.close()


def test_gymnasiums_checks_pass_and_a_seed_determines_an_episode(env: PushingEnv) -> None:
    check_env(env, skip_render_check=True)  # what it warns of is an error here
    picture = env.render()
    assert picture is not None and picture.shape == (424, 512, 3)
    runs = []
    for _ in range(2):
        seen = [env.reset(seed=3)[0]]
        for action in np.random.default_rng(0).uniform(-1, 1, size=(3, 4)).astype(np.float32):
            seen.append(env.step(action)[0])
        runs.append(seen)
    for one, other in zip(*runs, strict=True):
        for name in one:
            np.testing.assert_array_equal(one[name], other[name])


def test_every_two_choices_meet_in_some_world() -> None:
    few, every = covering(every_world()), every_world()
    assert set().union(*map(pairs, few)) == set().union(*map(pairs, every))
    sizes = sorted(map(len, [TASKS, *CHOICES.values()]))
    assert sizes[-1] * sizes[-2] <= len(few) <= len(every)
