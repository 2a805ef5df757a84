"""Gathering: all objects have to come together in a region."""

from __future__ import annotations

import pytest
import torch

from envs.layouts import load_task
from envs.pushing import PushingEnv
from envs.tasks import Outcome, TaskReward
from envs.tasks.gathering import Gathering
from envs.workspace import tile_center

# Two tiles, x 0.37 to 0.52 and y -0.11 to 0.19.
TASK = Gathering(region=[(1, 3), (1, 4)], target_start=[(1, 1)], obstacle_start=[(1, 6)])
INSIDE, BESIDE, FAR = tile_center((1, 3)), (0.54, 0.0), (0.72, 0.0)


def judge(*moves: tuple[tuple[float, float], tuple[float, float]], **options: object) -> Outcome:
    """Objects that move from one point to another."""
    before, after = (torch.tensor([(*move[end], 0.03) for move in moves], dtype=torch.float64) for end in (0, 1))
    return TaskReward(TASK, **options)(before, after, torch.ones(len(moves), dtype=torch.bool))


def test_it_succeeds_when_every_object_is_in_the_region() -> None:
    assert judge((INSIDE, INSIDE), (BESIDE, INSIDE)).success
    for moves in [((INSIDE, INSIDE), (INSIDE, BESIDE)), ((INSIDE, BESIDE), (INSIDE, INSIDE))]:
        outcome = judge(*moves)
        assert not outcome.success and not outcome.failure and outcome.reward == -1


def test_padding_need_not_be_in_the_region() -> None:
    centers = torch.tensor([(*INSIDE, 0.03), (*FAR, 0.03)])
    assert TaskReward(TASK)(centers, centers, torch.tensor([True, False])).success


def test_a_margin_makes_the_region_smaller() -> None:
    just_inside, well_inside = (0.51, 0.0), (0.49, 0.0)
    assert judge((BESIDE, just_inside)).success
    assert not judge((BESIDE, just_inside), margin=0.02).success
    assert judge((BESIDE, well_inside), margin=0.02).success


def test_nothing_is_forbidden_but_the_tables_edge() -> None:
    assert not judge((INSIDE, FAR), (BESIDE, INSIDE)).failure
    assert judge((INSIDE, INSIDE), (BESIDE, (0.54, 0.62))).fall


def test_planners_keep_objects_within_the_tools_reach_until_they_are_in_the_region() -> None:
    out_of_reach = (0.82, 0.0)  # the tool reaches x up to 0.80
    assert judge((FAR, out_of_reach), margin=0.02).violation
    assert not judge((FAR, out_of_reach)).violation  # the environment forbids nothing
    assert not judge((out_of_reach, out_of_reach), margin=0.02).violation
    assert not judge((out_of_reach, FAR), margin=0.02).violation
    at_the_robot = Gathering(region=[(0, 3)], target_start=[(1, 1)], obstacle_start=[(1, 6)])
    before, after = torch.tensor([[0.4, 0.0, 0.0]]), torch.tensor([[0.25, 0.0, 0.0]])  # out of reach, in the region
    assert not TaskReward(at_the_robot, margin=0.02)(before, after, torch.tensor([True])).violation


def test_the_dense_term_is_the_way_to_the_region_summed_over_objects() -> None:
    outcome = judge((FAR, BESIDE), (FAR, INSIDE), (INSIDE, INSIDE), reward="dense")
    assert outcome.terms["progress"].item() == pytest.approx(0.18 + 0.20)
    assert outcome.reward.item() == pytest.approx(-1 + 0.38)  # not every object is inside


def test_no_object_may_start_in_the_region() -> None:
    for name in ("target_start", "obstacle_start"):
        with pytest.raises(ValueError, match=rf"^{name} tile \[1, 3\] is in the region to gather in$"):
            Gathering(**{**vars(TASK), name: [(1, 3)]})


def test_its_layout_has_room_for_five_objects() -> None:
    env = PushingEnv(task="gathering", objects=5)
    observed, info = env.reset(seed=0)
    assert info["task"] == load_task("gathering", 0) and observed["mask"].all()
    env.close()
