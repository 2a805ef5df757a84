"""Worlds that the options `env.*` select, under Gymnasium's checker: every choice once, and every task.

The choices are read from the configuration, so that a new robot, object set, camera or segmentation is tried without a
line here. Worlds with an arm are tried by `make soak`. Meshes are looked for in `CAVIN_ASSETS`, by default
`../shared/assets` beside the repository.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from cavin_pyro.config.commands import WorldConfig
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import options
from cavin_pyro.envs.tabletop.tasks import TASKS
from cavin_pyro.evaluation.factory import make_runner
from tests.real_assets import REAL_ASSETS

CHOICES = [f"env.{one.name}={name}" for one in options(WorldConfig) for name in one.about.names or ()]
WORLDS = [
    pytest.param(world, marks=pytest.mark.soak if "robot" in world and "stick" not in world else ())
    for world in (*(f"task={task}" for task in TASKS), *CHOICES)
]


@pytest.mark.parametrize("world", WORLDS)
def test_gymnasiums_checks_pass_and_a_seed_determines_an_episode(world: str, configure: Any) -> None:
    assets = [f"env.assets={REAL_ASSETS}"] if REAL_ASSETS.is_dir() else []
    try:
        env = make_runner(configure("planner=random", world, *assets), render=True).env
    except UserError as error:
        if "assets" in str(error) and not assets:
            pytest.skip(f"no meshes at {REAL_ASSETS}, set CAVIN_ASSETS to their folder: {error}")
        raise
    try:
        check_env(env, skip_render_check=True)  # what it warns of is an error here
        picture = env.render()
        assert picture is not None and picture.shape == (400, 800, 3)
        runs = []
        for _ in range(2):
            seen = [env.reset(seed=3)[0]]
            for action in np.random.default_rng(0).uniform(-1, 1, size=(3, 4)).astype(np.float32):
                seen.append(env.step(action)[0])
            runs.append(seen)
        for one, other in zip(*runs, strict=True):
            for name in one:
                np.testing.assert_array_equal(one[name], other[name])
    finally:
        env.close()
