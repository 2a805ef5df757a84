"""docs/how-to/use-the-environments.md: its first blocks of code, and what it says of actions, `info` and rewards."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
import pytest

from envs.pushing import PushingEnv
from envs.workspace import MAXIMUM_MOTION, REACH_HIGH, REACH_LOW, push_endpoints
from tests.cavin_pyro.conftest import ROOT

PAGE = (ROOT / "docs" / "how-to" / "use-the-environments.md").read_text(encoding="utf-8")
FIRST, IN_METRES, *_ = re.findall(r"^```python\n(.*?)^```$", PAGE, re.MULTILINE | re.DOTALL)


def keys_of(heading: str) -> set[str]:
    """The first column of the table below a heading."""
    section = PAGE.partition(f"\n## {heading}\n")[2].partition("\n## ")[0]
    return set(re.findall(r"^\| `(\w+)` \|", section, re.MULTILINE))


def test_the_first_block_runs() -> None:
    found: dict[str, Any] = {}
    exec(compile(FIRST, "use-the-environments.md", "exec"), found)
    assert found["observation"]["clouds"].shape == (5, 256, 3) and found["info"]["steps"] == 1


def test_an_action_from_metres_pushes_the_target_where_the_page_says() -> None:
    found: dict[str, Any] = {}
    exec(compile(IN_METRES, "use-the-environments.md", "exec"), found)
    x, y, _ = found["target"]
    np.testing.assert_allclose(push_endpoints(found["action"]), [[x, y + 0.08], [x, y - 0.02]], atol=1e-5)
    moved = found["observation"]["centers"][0] - found["target"]
    assert (
        moved[1] < -0.03 and not found["info"]["unsafe"] and not found["terminated"] and found["info"]["stopped"] == ""
    )


def test_actions_are_scaled_and_clipped_as_the_page_says() -> None:
    assert "0.55 + 0.25 x, from 0.30 to 0.80" in PAGE and "0.55 y, from -0.55 to 0.55" in PAGE
    assert (REACH_LOW, REACH_HIGH, MAXIMUM_MOTION) == ((0.30, -0.55), (0.80, 0.55), 0.1)
    x, y, dx, dy = action = np.array([0.4, -0.2, 0.5, -1.0])
    start, end = push_endpoints(action)
    np.testing.assert_allclose(start, [0.55 + 0.25 * x, 0.55 * y])
    np.testing.assert_allclose(end, start + [0.1 * dx, 0.1 * dy])
    _, clipped = push_endpoints(np.array([2.0, 0.0, 1.0, 1.0]))
    np.testing.assert_allclose(clipped, [0.80, 0.1])


@pytest.mark.parametrize("reward", ["sparse", "dense"])
def test_keys_of_observations_info_and_terms_are_those_of_the_page(reward: str) -> None:
    env = PushingEnv(task="crossing", objects=1, reward=reward)
    try:
        observation, info = env.reset(seed=0)
        assert set(info) == {"steps", "task"}
        assert set(observation) == keys_of("What an observation holds")
        for key, value in observation.items():
            (shape, kind) = re.findall(rf"^\| `{key}` \| \[([^]]+)\] (\w+) \|", PAGE, re.MULTILINE)[0]
            assert value.shape == tuple(5 if one == "M" else int(one) for one in shape.split(", "))
            assert value.dtype == kind
        _, _, _, _, info = env.step(np.zeros(4, np.float32))
        assert set(info) == keys_of("What `info` holds")
        assert set(info["terms"]) == keys_of("The reward")
    finally:
        env.close()
