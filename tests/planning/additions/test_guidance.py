"""Guidance beyond the horizon: the remaining distance decides among plans that miss the goal, and among no others."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.layouts import parse_task
from cavin_pyro.envs.tabletop.tasks import TaskReward
from cavin_pyro.envs.tabletop.workspace import tile_center
from cavin_pyro.models.state import State
from cavin_pyro.planning import CavinPlanner, CvaeMpcPlanner
from cavin_pyro.planning.additions.guidance import GuidedReturn, GuidedTracking
from cavin_pyro.planning.protocol import Reward, SegmentRollout
from cavin_pyro.planning.returns import CumulativeReward, Progress, TrackingState
from tests.planning.conftest import GoalDisc

ARM = [[1, column] for column in range(1, 6)]
U = [*ARM, [2, 5], *[[3, column] for column in range(5, 0, -1)]]  # eleven tiles from (1, 1) round to (3, 1)


def bridge(**options: Any) -> TaskReward:
    tiles = {"region": U, "goal": [[3, 1]], "target_start": [[1, 1]], "obstacle_start": [[0, 0]]}
    return TaskReward(parse_task("crossing", tiles), **options)


class StraightDistance:
    """The straight distance of the target to a disc, at most 2 metres."""

    def __init__(self, disc: GoalDisc) -> None:
        self.disc = disc

    def __call__(self, centers: Tensor, mask: Tensor) -> Tensor:
        return (self.disc.distance(centers) - self.disc.radius).clamp(0.0, 2.0)

    def longest(self, mask: Tensor) -> Tensor:
        return torch.full_like(mask[..., 0], 2, dtype=torch.float32)


class GuidedDisc(GoalDisc):
    def distance_to_goal(self) -> StraightDistance:
        return StraightDistance(self)


def episode(planner: CavinPlanner, reward: Reward, state: State, plans: int) -> list[Tensor]:
    """Centres of the target [2] after each of so many first pushes, executed as f predicts them."""
    sources, seen = [torch.Generator().manual_seed(1)], []
    for _ in range(plans):
        plan = planner.plan(state, reward=reward, generators=sources)
        state = planner.model.next_state(state, plan.actions[:, 0])
        seen.append(state.centers[0, 0, :2])
    return seen


def test_a_goal_round_a_bend_beyond_the_horizon_is_found_with_guidance_and_not_without(toy: SimpleNamespace) -> None:
    reward, start, arrived = bridge(margin=0.02), toy.scenes([[tile_center((1, 1))]]), []
    for guidance in ([], ["guidance"]):
        additions = ["failure_avoidance", *guidance]
        planner = CavinPlanner(toy.PointMass(noise=0.005), samples=256, horizon=12, additions=additions)
        plan = planner.plan(start, reward=reward, generators=toy.generators(0))
        assert not plan.expected_success.any()  # 1.1 metres, at most 0.6 in a plan
        targets = torch.stack(episode(planner, reward, start, 60))
        arrived.append(bool(reward.task.goal.contains(targets).any()))
        if guidance:
            on_bridge = reward.task.region.contains(targets)
            first = int(reward.task.goal.contains(targets).int().argmax())
            assert on_bridge[: first + 1].all()
    assert arrived == [False, True]


def test_the_baselines_are_guided_too(toy: SimpleNamespace) -> None:
    reward, moved = GuidedDisc(goal=(2.0, 0.0)), []
    for guidance in ([], ["guidance"]):
        planner = CvaeMpcPlanner(toy.Flat(), samples=256, horizon=6, additions=["early_stopping", *guidance])
        plan = planner.plan(toy.scenes([[(0.0, 0.0)]]), reward=reward, generators=toy.generators(3))
        moved.append(float(plan.predicted_centers[0, -1, 0, 0]))
        assert plan.expected_return == -6.0  # the cumulative reward, without the value that guides
    assert moved[1] > max(0.25, moved[0])


def test_complete_plans_keep_their_order_and_their_lead_and_failed_ones_gain_on_nobody(toy: SimpleNamespace) -> None:
    disc = GuidedDisc(goal=(0.0, 0.0))
    objective = GuidedReturn(CumulativeReward(disc), disc.distance_to_goal())
    torch.manual_seed(0)
    plans = toy.scenes([[(x, y)] for x, y in torch.empty(300, 2).uniform_(-1.2, 1.2).tolist()])
    ends = torch.arange(300) % 3  # succeeded, failed, active
    steps = torch.randint(1, 60, (300,)).float()
    earned = torch.where(ends == 0, 100 - steps, torch.where(ends == 1, -100 - steps, torch.full_like(steps, -60.0)))
    progress = Progress(earned, ends == 0, ends == 1, torch.ones(300, dtype=torch.int64))
    potential = objective.potential(plans.centers, plans.mask)
    returns = objective.valued(progress, potential, potential, plans.mask).returns
    success, failed, active = (ends == kind for kind in range(3))
    assert torch.equal(returns[success], earned[success])
    assert returns[success].min() > returns[active].max() > returns[active].min() > returns[failed].max()
    assert torch.equal(returns[failed].argsort(), earned[failed].argsort())
    # Every failed plan loses at least as much as any other plan.
    assert ((earned - returns)[failed].min() >= (earned - returns)[active].max()).all()
    left = disc.distance_to_goal()(plans.centers, plans.mask)[active]
    assert returns[active].argmax() == left.argmin() and returns[active].argmin() == left.argmax()


class Tracked:
    """A tracking cost of 0."""

    def start(self, plans: State) -> Any:
        return None

    def advance(self, state: Any, segment: int, before: State, rollout: SegmentRollout) -> Any:
        nothing = torch.zeros(rollout.states.batch_shape)
        return TrackingState(nothing, nothing, nothing == 0)


def test_motions_that_fall_behind_their_subgoal_cost_more_and_those_beyond_it_do_not(toy: SimpleNamespace) -> None:
    disc = GuidedDisc(goal=(1.0, 0.0))
    subgoals = toy.scenes([[(0.5, 0.0)]] * 3).map(lambda field: field.unsqueeze(1))
    reached = toy.scenes([[(0.4, 0.0)], [(0.5, 0.0)], [(0.6, 0.0)]] * 3).map(lambda field: field.unflatten(0, (3, 3)))
    rollout = SegmentRollout(torch.zeros(3, 3, 1), None, reached, reached.centers.unsqueeze(2))
    # Guided; its plan reaches the goal; its plan has ended before this segment.
    segments, guided = torch.tensor([1, 1, 0]), torch.tensor([True, False, True])
    cost = GuidedTracking(Tracked(), disc.distance_to_goal(), subgoals, segments, guided)  # type: ignore[arg-type]
    after = cost.advance(cost.start(reached), 0, reached, rollout)
    torch.testing.assert_close(after.cost, torch.tensor([[0.01, 0.0, 0.0], [0.0] * 3, [0.0] * 3]))
    assert not after.executed_cost.any()


def test_what_cannot_guide_is_refused_in_one_line(toy: SimpleNamespace) -> None:
    planner = CavinPlanner(toy.PointMass(), additions=["guidance"])
    with pytest.raises(ValueError, match=r"^the addition guidance needs a reward with a `distance_to_goal`"):
        planner.plan(toy.scenes([[(0.0, 0.0)]]), reward=toy.Line(), generators=toy.generators(0))
