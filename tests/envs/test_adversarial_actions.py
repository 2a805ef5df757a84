"""Whatever is asked for, the world stays a world."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from envs.pushing import PushingEnv
from envs.workspace import TABLE_HIGH, TABLE_LOW

NUMBERS = st.one_of(st.floats(-1.0, 1.0), st.floats(width=32))  # as policies give them, and any at all


@pytest.fixture(scope="module")
def env() -> Iterator[PushingEnv]:
    made = PushingEnv(task="clearing", objects=4, maximum_steps=10**6)
    made.reset(seed=0)
    yield made
    made.close()


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.lists(NUMBERS, min_size=4, max_size=4))
@example([np.nan, 0.0, 0.0, 0.0])
@example([0.0, 0.0, -np.inf, 0.0])
@example([1e30, -1e30, 1e30, 1e30])
def test_any_four_numbers_are_carried_out_in_the_reach_or_refused(env: PushingEnv, numbers: list[float]) -> None:
    action, steps, before = np.array(numbers, dtype=np.float32), env._steps, env.scene.ground_truth().positions
    if not np.isfinite(action).all():
        with pytest.raises(ValueError, match="four finite numbers"):
            env.step(action)
        np.testing.assert_array_equal(env.scene.ground_truth().positions, before)
        assert env._steps == steps
        return
    observed, reward, terminated, _, info = env.step(action)
    assert env.observation_space.contains(observed) and np.isfinite(reward)
    after = env.scene.ground_truth().positions
    on_table = ((after[:, :2] > TABLE_LOW) & (after[:, :2] < TABLE_HIGH)).all(axis=-1)
    assert (after[on_table, 2] > 0.0).all()  # through the table nothing goes
    if info["unsafe"]:
        np.testing.assert_array_equal(after, before)
    assert np.linalg.norm((after - before)[on_table], axis=-1).max(initial=0.0) < 0.3  # the tool goes 0.14 m at most
    if terminated:
        env.reset()


@pytest.mark.parametrize("action", [[], [0.0] * 5, [[0.0] * 4], 0.0])
def test_what_has_not_four_numbers_is_refused(env: PushingEnv, action: object) -> None:
    with pytest.raises(ValueError, match="four finite numbers"):
        env.step(np.array(action, dtype=np.float32))
