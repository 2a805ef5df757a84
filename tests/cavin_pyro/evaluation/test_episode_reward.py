"""A planner's reward follows the layout of the episode."""

from __future__ import annotations

from typing import Any

import torch

from cavin_pyro.evaluation.evaluation import evaluate
from cavin_pyro.evaluation.factory import make_runner
from cavin_pyro.evaluation.rollout import rollout
from envs.tasks import TaskReward
from envs.workspace import tile_center

RANDOM = ("task=insertion", "layout=random", "planner.samples=8", "planner.horizon=6", "maximum_steps=2")


def test_a_planner_uses_the_layout_of_the_episode(configure: Any) -> None:
    runner = make_runner(configure(*RANDOM, "reward=dense", "margin=0.03"))
    layouts = set()
    judged = []
    for seed in range(8):
        _, info = runner.env.reset(seed=seed)
        assert runner.planner.reward.task == runner.task == runner.env.task == info["task"]
        fresh = TaskReward(info["task"], reward="dense", margin=0.03)
        mask = torch.ones(3, dtype=torch.bool)
        before, after = 0.3 + 0.6 * torch.rand(2, 50, 3, 3)
        after[0, 0, :2] = torch.tensor(tile_center(info["task"].goal.tiles[0]))
        told, expected = runner.planner.reward(before, after, mask), fresh(before, after, mask)
        for name in ("reward", "success", "failure"):
            assert torch.equal(getattr(told, name), getattr(expected, name))
        layouts.add(info["task"])
        judged.append(fresh(before, after, mask).success.any())
    runner.env.close()
    assert len(layouts) > 2 and any(judged)
    assert (runner.planner.reward.dense, runner.planner.reward.margin) == (True, 0.03)


def test_an_earlier_episode_does_not_change_what_is_planned_in_a_later_one(configure: Any) -> None:
    plans = []
    for earlier in ([], [4, 5]):
        runner = make_runner(configure(*RANDOM))
        for seed in [*earlier, 6]:
            episode = rollout(runner.env, runner.planner, runner.geometry, seed=seed)
        plans.append(episode.plan_records[0].plan)
        runner.env.close()
    for one, other in zip(plans[0], plans[1], strict=True):
        if isinstance(one, torch.Tensor):
            assert torch.equal(one, other)


def test_episodes_of_random_layouts_can_be_evaluated(configure: Any, tmp_path: Any) -> None:
    rows = evaluate(configure(*RANDOM, "episodes=2"), tmp_path)
    assert [row["seed"] for row in rows] == [0, 1]
