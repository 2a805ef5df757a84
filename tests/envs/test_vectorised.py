"""Environments side by side, through Gymnasium's vector API."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, VectorEnv

NAME = "cavin/Crossing-v0"
OPTIONS: dict[str, Any] = {"objects": 2, "maximum_steps": 2}
MODES = ("sync", "async")
SEEDS = [5, 6]
ACTIONS = np.random.default_rng(0).uniform(-1, 1, size=(5, len(SEEDS), 4)).astype(np.float32)
Make = Callable[..., VectorEnv]


@pytest.fixture
def make() -> Iterator[Make]:
    made: list[VectorEnv] = []

    def build(mode: str, autoreset: AutoresetMode, **options: Any) -> VectorEnv:
        envs = gymnasium.make_vec(
            NAME,
            num_envs=len(SEEDS),
            vectorization_mode=mode,
            vector_kwargs={"autoreset_mode": autoreset},
            **{**OPTIONS, **options},
        )
        made.append(envs)
        return envs

    yield build
    for envs in made:
        envs.close()


def assert_equal(together: dict[str, np.ndarray], number: int, alone: dict[str, np.ndarray]) -> None:
    assert set(together) == set(alone)
    for name in alone:
        assert together[name].dtype == alone[name].dtype
        np.testing.assert_array_equal(together[name][number], alone[name])


@pytest.mark.parametrize("mode", MODES)
def test_each_environment_goes_on_as_it_does_alone(mode: str, make: Make) -> None:
    """Over the end of an episode: the step after it resets, as `AutoresetMode.NEXT_STEP` says."""
    envs = make(mode, AutoresetMode.NEXT_STEP)
    alone = [gymnasium.make(NAME, **OPTIONS) for _ in SEEDS]
    observed, _ = envs.reset(seed=SEEDS)
    for number, env in enumerate(alone):
        assert_equal(observed, number, env.reset(seed=SEEDS[number])[0])
    ended = [False] * len(SEEDS)
    resets = 0
    for actions in ACTIONS:
        observed, rewards, terminated, truncated, info = envs.step(actions)
        for number, env in enumerate(alone):
            if ended[number]:
                one, reward, ends = env.reset()[0], 0.0, (False, False)
                resets += 1
            else:
                one, reward, *ends, told = env.step(actions[number])
                assert info["unsafe"][number] == told["unsafe"] and info["steps"][number] == told["steps"]
            assert_equal(observed, number, one)
            assert (rewards[number], terminated[number], truncated[number]) == (reward, *ends)
            ended[number] = any(ends)
    assert resets >= len(SEEDS)
    for env in alone:
        env.close()


@pytest.mark.parametrize("mode", MODES)
def test_the_autoreset_mode_is_named_and_the_last_observation_is_not_lost(mode: str, make: Make) -> None:
    envs = make(mode, AutoresetMode.SAME_STEP)
    assert envs.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    alone = gymnasium.make(NAME, **OPTIONS)
    envs.reset(seed=SEEDS)
    alone.reset(seed=SEEDS[0])
    for actions in ACTIONS[:2]:
        observed, _, _, truncated, info = envs.step(actions)
        last, *_ = alone.step(actions[0])
    assert truncated.all() and info["_final_obs"].all()
    for name, array in last.items():
        np.testing.assert_array_equal(info["final_obs"][0][name], array)
    assert_equal(observed, 0, alone.reset()[0])
    alone.close()


@pytest.mark.parametrize("mode", MODES)
def test_every_environment_tells_its_own_layout(mode: str, make: Make) -> None:
    envs = make(mode, AutoresetMode.DISABLED, layout="random")
    sampled = set()
    for seed in range(6):
        _, info = envs.reset(seed=[seed, seed + 100])
        assert list(info["task"]) == list(envs.get_attr("task"))
        sampled |= set(info["task"])
    assert len(sampled) > 1


def test_observations_of_earlier_steps_keep_their_content(make: Make) -> None:
    envs = make("async", AutoresetMode.NEXT_STEP)
    observed, _ = envs.reset(seed=SEEDS)
    kept = {name: array.copy() for name, array in observed.items()}
    envs.step(ACTIONS[0])
    for name, array in kept.items():
        np.testing.assert_array_equal(observed[name], array)
