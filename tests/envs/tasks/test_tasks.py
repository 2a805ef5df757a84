"""Rewards as the paper's appendix "Task Details" defines them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from torch import Tensor

from envs.tasks import Outcome, Task, TaskReward
from envs.tasks.clearing import Clearing
from envs.tasks.crossing import Crossing
from envs.tasks.insertion import Insertion
from envs.workspace import tile_center

# A square of four tiles in the table's middle, x 0.37 to 0.67 and y -0.11 to 0.19.
SQUARE = ((1, 3), (1, 4), (2, 3), (2, 4))
CLEARING = Clearing(region=SQUARE, target_start=[(1, 3)], obstacle_start=[(2, 4)])
EVERYWHERE = Clearing(
    region=[(i, j) for i in range(5) for j in range(7)], target_start=[(1, 3)], obstacle_start=[(2, 4)]
)
# A slot of two tiles between two forbidden ones.
INSERTION = Insertion(region=[(1, 1), (4, 1)], goal=[(2, 1), (3, 1)], target_start=[(2, 4)], obstacle_start=[(1, 4)])
# A straight bridge along y, x 0.52 to 0.67 and y -0.26 to 0.19.
CROSSING = Crossing(region=[(2, 2), (2, 3), (2, 4)], goal=[(2, 2)], target_start=[(2, 4)], obstacle_start=[(1, 4)])
ASIDE = (0.90, 0.40)  # on the table, outside every region above
Point = tuple[float, float]


def states(*points: Point) -> Tensor:
    """Objects at planar points, 3 cm above the table: [M, 3] float64."""
    return torch.tensor([[x, y, 0.03] for x, y in points], dtype=torch.float64)


def judge(
    task: Task,
    before: Sequence[Point],
    after: Sequence[Point],
    *,
    reward: str = "sparse",
    margin: float = 0.0,
) -> Outcome:
    mask = torch.ones(len(after), dtype=torch.bool)
    return TaskReward(task, reward=reward, margin=margin)(states(*before), states(*after), mask)


def tile(i: float, j: float) -> Point:
    return tile_center((i, j))


def test_a_step_that_decides_nothing_costs_one() -> None:
    for task in (CLEARING, INSERTION, CROSSING):
        outcome = judge(task, [tile(2, 4), ASIDE], [tile(2, 3.9), ASIDE])
        assert outcome.reward == -1
        assert not outcome.success and not outcome.failure


def test_clearing_succeeds_when_no_object_remains_in_the_region() -> None:
    both_in, one_in, both_out = [tile(1, 3), tile(2, 4)], [ASIDE, tile(2, 4)], [ASIDE, tile(3.1, 4)]
    assert not judge(CLEARING, both_in, one_in).success
    outcome = judge(CLEARING, one_in, both_out)
    assert outcome.success and outcome.reward == 99
    assert not judge(CLEARING, both_out, one_in).failure  # going back in is allowed


def test_insertion_succeeds_when_the_target_is_in_the_slot() -> None:
    outcome = judge(INSERTION, [tile(2, 2), ASIDE], [tile(2, 1.4), ASIDE])
    assert outcome.success and outcome.reward == 99
    assert judge(INSERTION, [tile(3, 2), ASIDE], [tile(3, 1), ASIDE]).success
    assert not judge(INSERTION, [tile(2, 2), ASIDE], [tile(2, 1.6), ASIDE]).success
    assert not judge(INSERTION, [ASIDE, tile(2, 2)], [ASIDE, tile(2, 1)]).success  # an obstacle in the slot


@pytest.mark.parametrize("number", [0, 1, 2])
def test_insertion_fails_when_any_object_enters_the_restricted_region(number: int) -> None:
    before = [tile(2, 4), tile(0, 5), ASIDE]
    after = [*before]
    after[number] = tile(1, 1.4)
    outcome = judge(INSERTION, before, after)
    assert outcome.violation and outcome.failure and not outcome.success
    assert outcome.reward == -101


def test_crossing_fails_when_the_target_leaves_the_bridge_but_not_when_an_obstacle_does() -> None:
    on, off = tile(2, 3), tile(2.6, 3)
    outcome = judge(CROSSING, [on, on], [off, on])
    assert outcome.violation and outcome.reward == -101
    assert not judge(CROSSING, [on, on], [on, off]).failure


def test_crossing_succeeds_when_the_target_reaches_the_goal() -> None:
    outcome = judge(CROSSING, [tile(2, 3), ASIDE], [tile(2, 2.4), ASIDE])
    assert outcome.success and outcome.reward == 99
    assert not judge(CROSSING, [ASIDE, tile(2, 3)], [ASIDE, tile(2, 2)]).success


@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
@pytest.mark.parametrize("off", [(0.21, 0.0), (0.99, 0.0), (0.6, 0.62), (0.6, -0.62)])
def test_any_object_off_the_table_ends_every_task(task: Task, off: Point) -> None:
    for after in ([tile(2, 4), off], [off, tile(2, 4)]):
        outcome = judge(task, [tile(2, 4), ASIDE], after)
        assert outcome.fall and outcome.failure and not outcome.violation and not outcome.success
        assert outcome.reward == -101


def test_a_violation_outweighs_success_and_a_fall_outweighs_both() -> None:
    in_slot, forbidden, off = tile(2, 1), tile(1, 1), (1.2, 0.0)
    before = [tile(2, 2), ASIDE, ASIDE]
    outcomes = [
        judge(INSERTION, before, [in_slot, ASIDE, ASIDE]),
        judge(INSERTION, before, [in_slot, forbidden, ASIDE]),
        judge(INSERTION, before, [in_slot, ASIDE, off]),
        judge(INSERTION, before, [in_slot, forbidden, off]),
        judge(CLEARING, [tile(1, 3), ASIDE], [off, ASIDE]),
    ]
    flags = [(bool(one.success), bool(one.violation), bool(one.fall)) for one in outcomes]
    success, violation, fall = (True, False, False), (False, True, False), (False, False, True)
    assert flags == [success, violation, fall, fall, fall]
    assert [one.reward.item() for one in outcomes] == [99, -101, -101, -101, -101]


@pytest.mark.parametrize(("task", "start"), [(INSERTION, (2, 4)), (CROSSING, (2, 4))])
def test_the_dense_term_is_the_targets_way_towards_the_goal_in_metres(task: Task, start: Point) -> None:
    far, near = tile(*start), tile(start[0], start[1] - 0.2)  # 0.2 tiles are 3 cm
    towards = judge(task, [far, ASIDE], [near, ASIDE], reward="dense")
    away = judge(task, [near, ASIDE], [far, ASIDE], reward="dense")
    assert towards.terms["progress"].item() == pytest.approx(0.03)
    assert towards.reward.item() == pytest.approx(-1 + 0.03)
    assert away.terms["progress"].item() == pytest.approx(-0.03)
    assert away.reward.item() == pytest.approx(-1 - 0.03)


def test_obstacles_earn_nothing_where_there_is_a_target() -> None:
    for task in (INSERTION, CROSSING):
        outcome = judge(task, [tile(2, 4), tile(3, 5)], [tile(2, 4), tile(2, 5)], reward="dense")
        assert outcome.terms["progress"] == 0 and outcome.reward == -1


def test_insertion_pulls_the_target_to_the_nearest_tile_of_the_slot() -> None:
    above_second = judge(INSERTION, [tile(3, 4), ASIDE], [tile(3, 3), ASIDE], reward="dense")
    assert above_second.terms["progress"].item() == pytest.approx(0.15)


@pytest.mark.parametrize(
    ("near", "outwards"),
    [((0.27, 0.0), (-1, 0)), ((0.93, 0.0), (1, 0)), ((0.6, -0.5), (0, -1)), ((0.6, 0.45), (0, 1))],
)
def test_clearing_pulls_objects_to_the_nearest_of_all_four_edges(near: Point, outwards: Point) -> None:
    there = (near[0] + 0.02 * outwards[0], near[1] + 0.02 * outwards[1])
    for objects in ([near, tile(2, 3)], [tile(2, 3), near]):  # whichever object it is
        moved = [there if point == near else point for point in objects]
        towards = judge(EVERYWHERE, objects, moved, reward="dense")
        away = judge(EVERYWHERE, moved, objects, reward="dense")
        assert towards.terms["progress"].item() == pytest.approx(0.02)
        assert away.terms["progress"].item() == pytest.approx(-0.02)
        assert away.reward.item() == pytest.approx(-1.02)


def test_clearing_counts_only_what_remains_in_the_region() -> None:
    inside, outside = tile(2, 3), tile(3.2, 3)
    assert judge(CLEARING, [inside, outside], [inside, ASIDE], reward="dense").terms["progress"] == 0
    leaving = judge(CLEARING, [inside, inside], [inside, outside], reward="dense")
    assert leaving.terms["progress"].item() == pytest.approx(inside[0] - 0.22)  # all that was left of its way


def test_a_sparse_reward_knows_no_progress() -> None:
    outcome = judge(CROSSING, [tile(2, 4), ASIDE], [tile(2, 3), ASIDE])
    assert outcome.reward == -1
    assert outcome.terms["progress"] == 0


COORDINATES = st.tuples(st.floats(0.23, 0.97), st.floats(-0.6, 0.6))


@settings(deadline=None, max_examples=50)
@given(st.lists(st.tuples(COORDINATES, COORDINATES), min_size=2, max_size=6))
@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
def test_going_in_circles_earns_no_progress(task: Task, path: list) -> None:
    reward, mask = TaskReward(task, reward="dense"), torch.tensor([True, True])
    visited = [states(*points) for points in [*path, path[0]]]
    total = sum(reward(a, b, mask).terms["progress"] for a, b in pairwise(visited))
    assert total.item() == pytest.approx(0.0, abs=1e-12)


# Margins: 2 cm stricter than the task.


@pytest.mark.parametrize("task", [INSERTION, CROSSING])
def test_a_margin_leaves_the_goal_as_it_is(task: Task) -> None:
    just_in, well_in = tile(2, task.goal.tiles[0][1] + 0.45), tile(2, task.goal.tiles[0][1] + 0.3)
    before = [tile(2, task.goal.tiles[0][1] + 0.8), ASIDE]
    assert judge(task, before, [just_in, ASIDE]).success
    assert judge(task, before, [just_in, ASIDE], margin=0.02).success
    assert judge(task, before, [well_in, ASIDE], margin=0.02).success


def test_a_margin_widens_the_region_to_clear() -> None:
    just_out, well_out = (0.68, 0.0), (0.70, 0.0)
    assert judge(CLEARING, [tile(2, 3)], [just_out]).success
    assert not judge(CLEARING, [tile(2, 3)], [just_out], margin=0.02).success
    assert judge(CLEARING, [tile(2, 3)], [well_out], margin=0.02).success


# Each: task, what is judged (violation or fall), and points of the target further and further out: 25, 15,
# 10 and 5 mm from what is forbidden, and 5 mm into it.
OUTWARDS = {
    "bridge": (CROSSING, "violation", [(0.67 - d, 0.0) for d in (0.025, 0.015, 0.010, 0.005, -0.005)]),
    "slot": (INSERTION, "violation", [(0.52 + d, -0.335) for d in (0.025, 0.015, 0.010, 0.005, -0.005)]),
    "table": (CLEARING, "fall", [(0.98 - d, 0.0) for d in (0.025, 0.015, 0.010, 0.005, -0.005)]),
}


@pytest.mark.parametrize("place", OUTWARDS)
def test_within_the_margin_an_object_may_stay_or_go_back_but_not_further_out(place: str) -> None:
    task, flag, (outside, first, second, third, forbidden) = OUTWARDS[place]

    def fails(before: Point, after: Point, margin: float) -> bool:
        return bool(getattr(judge(task, [before, tile(2, 4)], [after, tile(2, 4)], margin=margin), flag))

    assert fails(outside, second, 0.02)  # into the margin
    assert fails(first, second, 0.02)  # further out within it
    assert not fails(second, second, 0.02)
    assert not fails(third, first, 0.02)
    assert not fails(first, outside, 0.02)
    assert fails(third, forbidden, 0.02) and fails(forbidden, forbidden, 0.02)
    # Without a margin only what is forbidden counts.
    assert not fails(outside, third, 0.0) and not fails(first, second, 0.0)
    assert fails(third, forbidden, 0.0)


def test_the_published_criterion_tolerates_a_tile_and_a_half_beside_the_bridge() -> None:
    reward, mask = TaskReward(CROSSING, criterion="published"), torch.tensor([True])

    def violated(x: float) -> bool:
        return bool(reward(torch.tensor([[0.6, 0.0, 0.0]]), torch.tensor([[x, 0.0, 0.0]]), mask).violation)

    assert [violated(0.67 + d) for d in (-0.01, 0.01, 0.22, 0.23)] == [False, False, False, True]
    assert TaskReward(CROSSING)(torch.zeros(1, 3), torch.tensor([[0.68, 0.0, 0.0]]), mask).violation


def test_by_the_published_criterion_insertion_forbids_no_place() -> None:
    inside = torch.tensor([[*tile(1, 1), 0.0]])
    strict, published = (TaskReward(INSERTION, criterion=name) for name in ("strict", "published"))
    mask = torch.tensor([True])
    assert strict(inside, inside, mask).violation and not published(inside, inside, mask).violation
    off = torch.tensor([[0.99, 0.0, 0.0]])
    assert published(inside, off, mask).fall


@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
def test_what_the_published_criterion_forbids_is_forbidden_by_the_strict_one(task: Task) -> None:
    points = torch.cartesian_prod(torch.linspace(0.2, 1.0, 40), torch.linspace(-0.63, 0.63, 40))
    centers = torch.cat((points, torch.zeros(len(points), 1)), -1).unsqueeze(-2)
    mask = torch.ones(len(points), 1, dtype=torch.bool)
    strict, published = (TaskReward(task, criterion=name)(centers, centers, mask) for name in ("strict", "published"))
    assert not (published.violation & ~strict.violation).any()
    assert (published.violation == published.failure & ~published.fall).all()


@pytest.mark.parametrize("margin", [-0.01, math.nan])
def test_a_negative_margin_is_refused(margin: float) -> None:
    with pytest.raises(ValueError, match=r"^margin must be at least 0 metres, not (-0.01|nan)$"):
        TaskReward(CROSSING, margin=margin)


def test_the_error_of_an_unknown_reward_lists_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"^unknown reward 'shaped': choose from dense, sparse$"):
        TaskReward(CROSSING, reward="shaped")


# Tensors.


@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
def test_leading_dimensions_broadcast_and_every_element_is_judged_alone(task: Task) -> None:
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor([0.2, -0.63, 0.0]), torch.tensor([1.0, 0.63, 0.1])
    before = low + (high - low) * torch.rand(4, 1, 3, 3, generator=generator)
    after = (before + 0.1 * torch.randn(4, 50, 3, 3, generator=generator)).clamp(low, high)
    mask = torch.tensor([[True, True, True], [True, True, False], [True, False, False], [True] * 3])[:, None]
    reward = TaskReward(task, reward="dense", margin=0.01)
    together = reward(before, after, mask)
    assert all(field.shape == (4, 50) for field in (*together.terms.values(), *together[2:], together.reward))
    for field in (together.success, together.failure):
        assert field.dtype == torch.bool
    assert together.failure.any() and not together.failure.all()
    for row in range(4):
        for column in range(0, 50, 7):
            alone = reward(before[row, 0], after[row, column], mask[row, 0])
            assert torch.equal(alone.reward, together.reward[row, column])
            assert torch.equal(alone.failure, together.failure[row, column])
            assert torch.equal(alone.success, together.success[row, column])


@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_a_path_is_judged_as_its_steps_one_after_another(task: Task, margin: float) -> None:
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor([0.2, -0.63, 0.0]), torch.tensor([1.0, 0.63, 0.1])
    begin = low + (high - low) * torch.rand(500, 1, 3, 3, generator=generator)
    path = begin + 0.05 * torch.randn(500, 4, 3, 3, generator=generator).cumsum(1)
    mask = torch.rand(500, 3, generator=generator) < 0.8
    reward = TaskReward(task, reward="dense", margin=margin)
    together = reward.along(path, mask)
    for step, (before, after) in enumerate(pairwise(path.unbind(1))):
        alone, one = reward(before, after, mask), together.step(step)
        for ours, theirs in zip((*one.terms.values(), *one[2:]), (*alone.terms.values(), *alone[2:]), strict=True):
            assert torch.equal(ours, theirs)
    assert 20 < int(together.failure[:, 0].sum()) < 480


@pytest.mark.parametrize("padding", [0.0, 0.5, -9.0, math.nan])
@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
@pytest.mark.parametrize("margin", [0.0, 0.02])
def test_padding_changes_nothing(task: Task, padding: float, margin: float) -> None:
    before, after = states(tile(2, 4), tile(3, 4)), states(tile(2, 3.8), tile(3, 3.8))
    filler = torch.full((3, 3), padding, dtype=torch.float64)
    reward = TaskReward(task, reward="dense", margin=margin)
    plain = reward(before, after, torch.tensor([True, True]))
    mask = torch.tensor([True, True, False, False, False])
    padded = reward(torch.cat([before, filler]), torch.cat([after, filler]), mask)
    for one, other in zip((*plain.terms.values(), *plain[2:]), (*padded.terms.values(), *padded[2:]), strict=True):
        assert torch.equal(one, other)


@pytest.mark.parametrize(("task", "goal"), [(CLEARING, tile(3.1, 4)), (INSERTION, tile(2, 1)), (CROSSING, tile(2, 2))])
def test_padding_within_the_region_to_clear_does_not_hinder_success(task: Task, goal: Point) -> None:
    before, after = states(tile(2, 2.6), ASIDE, tile(2, 3)), states(goal, ASIDE, tile(2, 3))
    assert TaskReward(task)(before, after, torch.tensor([True, True, False])).success


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("task", [CLEARING, INSERTION, CROSSING])
def test_the_reward_has_the_precision_of_the_states(task: Task, dtype: torch.dtype) -> None:
    before, after = states(tile(2, 4), ASIDE), states(tile(2, 3.9), ASIDE)
    outcome = TaskReward(task, reward="dense")(before.to(dtype), after.to(dtype), torch.tensor([True, True]))
    assert outcome.reward.dtype == outcome.terms["progress"].dtype == dtype


def test_double_precision_is_not_lost_on_the_way() -> None:
    step = 1e-12  # metres; far below what single precision tells apart
    outcome = judge(CROSSING, [tile(2, 3), ASIDE], [(tile(2, 3)[0], tile(2, 3)[1] - step), ASIDE])
    assert outcome.terms["progress"].item() == pytest.approx(step, rel=1e-3)


@given(
    task=st.sampled_from([CLEARING, INSERTION, CROSSING]),
    path=st.lists(st.tuples(st.floats(0.2, 1.0), st.floats(-0.6, 0.6)), min_size=2, max_size=8),
)
def test_no_episode_returns_more_than_the_maximum_return(task: Task, path: list[Point]) -> None:
    total = 0.0
    for before, after in pairwise(path):
        step = judge(task, [before], [after])
        total += float(step.reward)
        if step.success or step.failure:
            break
    assert total <= TaskReward(task).maximum_return


def test_an_immediate_success_returns_the_maximum() -> None:
    assert judge(CROSSING, [ASIDE], [tile(2, 2)]).reward == TaskReward(CROSSING).maximum_return
    assert TaskReward(CROSSING, reward="dense").maximum_return == math.inf  # progress is earned, too
