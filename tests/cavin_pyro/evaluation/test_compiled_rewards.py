"""Native code judges the steps of plans as torch does."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
import torch
from torch import Tensor

from envs.layouts import load_task
from envs.tasks import TaskReward
from envs.workspace import TABLE_HIGH, TABLE_LOW
from planning.backends.compiled import Compiled
from planning.protocol import RewardFunction
from planning.rollouts import returns
from planning.rollouts.returns import Progress
from tests.compiler import needs_a_compiler

PLANS = 4000


def judged(progress: Progress, reward: RewardFunction, start: Tensor, path: Tensor, mask: Tensor) -> Progress:
    return returns.advance(progress, reward, start, path, mask)


def traced(function: Callable[..., Any], *arguments: Any) -> Any:
    """What would be made native code of, called by torch."""
    return torch.compile(function, backend="eager", fullgraph=True)(*arguments)


def compiled(function: Callable[..., Any], *arguments: Any) -> Any:
    return Compiled()(function, *arguments)


@pytest.mark.parametrize(
    ("task", "reward", "native"),
    [
        ("clearing", "dense", traced),
        ("insertion", "sparse", traced),
        ("crossing", "sparse", traced),
        pytest.param("crossing", "sparse", compiled, marks=[needs_a_compiler, pytest.mark.soak]),
    ],
)
def test_compiled_rewards_equal_those_of_the_environment(task: str, reward: str, native: Callable[..., Any]) -> None:
    chance = torch.Generator().manual_seed(0)
    low, high = torch.tensor([*TABLE_LOW, 0.0]) - 0.02, torch.tensor([*TABLE_HIGH, 0.1]) + 0.02
    start = low + (high - low) * torch.rand(1, PLANS, 3, 3, generator=chance)
    path = start.unsqueeze(-3) + 0.1 * torch.randn(1, PLANS, 3, 3, 3, generator=chance).cumsum(-3)
    path[0, 0, 1, 1, 0], path[0, 1, 2, 2, 1] = torch.nan, torch.inf
    mask = torch.rand(1, PLANS, 3, generator=chance) < 0.8
    mask[..., 0] = True
    task_reward = TaskReward(load_task(task, 1), reward=reward, margin=0.02)
    with torch.inference_mode():
        given = returns.start(start), task_reward, start, path, mask
        expected, found = judged(*given), native(judged, *given)
    assert 100 < int(expected.failed.sum()) < PLANS - 100
    assert expected.succeeded.any()
    for ours, theirs in zip(found[1:], expected[1:], strict=True):
        assert torch.equal(ours, theirs)
    torch.testing.assert_close(found.returns, expected.returns, rtol=1e-5, atol=1e-5)
