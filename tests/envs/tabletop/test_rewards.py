"""Rewards as the paper's appendix "Task Details" defines them, and the remaining distance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise

import pytest
import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.layouts import load_task, parse_task
from cavin_pyro.envs.tabletop.tasks import Outcome, Task, TaskReward
from cavin_pyro.envs.tabletop.tasks.clearing import Clearing
from cavin_pyro.envs.tabletop.tasks.crossing import Crossing
from cavin_pyro.envs.tabletop.tasks.insertion import Insertion
from cavin_pyro.envs.tabletop.tasks.tiles import SPACING
from cavin_pyro.envs.tabletop.workspace import TILE_SIDE, Tile, tile_center

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


def test_the_published_criterion_tolerates_a_tile_and_a_half_beside_the_bridge_and_all_of_insertion() -> None:
    reward, mask = TaskReward(CROSSING, criterion="published"), torch.tensor([True])

    def violated(x: float) -> bool:
        return bool(reward(torch.tensor([[0.6, 0.0, 0.0]]), torch.tensor([[x, 0.0, 0.0]]), mask).violation)

    assert [violated(0.67 + d) for d in (-0.01, 0.01, 0.22, 0.23)] == [False, False, False, True]
    assert TaskReward(CROSSING)(torch.zeros(1, 3), torch.tensor([[0.68, 0.0, 0.0]]), mask).violation
    inside = torch.tensor([[*tile(1, 1), 0.0]])
    assert TaskReward(INSERTION)(inside, inside, mask).violation
    assert not TaskReward(INSERTION, criterion="published")(inside, inside, mask).violation


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


# A region up to the robot's side of the table, x 0.22 to 0.52 and y -0.11 to 0.19. The tool reaches x from 0.30 on.
AT_THE_ROBOT = Clearing(region=[(0, 3), (0, 4), (1, 3), (1, 4)], target_start=[(1, 3)], obstacle_start=[(1, 4)])


@pytest.mark.parametrize(
    ("before", "after", "dead_end"),
    [
        ((0.40, 0.0), (0.33, 0.0), False),
        ((0.40, 0.0), (0.31, 0.0), True),  # within the margin
        ((0.40, 0.0), (0.25, 0.0), True),
        ((0.31, 0.0), (0.25, 0.0), True),  # farther, from within the margin
        ((0.28, 0.0), (0.26, 0.0), True),
        ((0.28, 0.0), (0.277, 0.0), False),  # as far as predictions tell
        ((0.26, 0.0), (0.26, 0.1), False),  # sideways
        ((0.26, 0.0), (0.33, 0.0), False),  # back
        ((0.26, 0.25), (0.26, 0.15), True),  # into the region
        ((0.40, 0.25), (0.25, 0.25), False),  # beside the region, where nothing is left to do
    ],
)
def test_planners_keep_what_is_in_the_region_to_clear_within_the_tools_reach(
    before: Point, after: Point, dead_end: bool
) -> None:
    for others in ([], [tile(1, 3)]):
        moved = [before, *others], [after, *others]
        assert judge(AT_THE_ROBOT, *moved, margin=0.02).violation == dead_end
        assert not judge(AT_THE_ROBOT, *moved).violation  # the environment forbids nothing


UPPER = [(1, column) for column in range(1, 6)]
U = [*UPPER, (2, 5), *[(3, column) for column in range(1, 6)]]
ERROR = 0.035  # metres, of the grid round two corners


def crossing(region: list[Tile], goal: Tile) -> TaskReward:
    start = next(tile for tile in region if tile != goal)
    return TaskReward(
        parse_task("crossing", {"region": region, "goal": [goal], "target_start": [start], "obstacle_start": [start]})
    )


def left(reward: TaskReward, *places: tuple[float, float]) -> float:
    """Metres from the centres of objects in the middle of these tiles, or between them."""
    centers = torch.tensor([[*tile_center(place), 0.03] for place in places], dtype=torch.float32)
    return float(reward.distance_to_goal()(centers, torch.ones(len(places), dtype=torch.bool)))


def test_the_distance_follows_a_bridge_round_its_bend() -> None:
    reward = crossing(U, (3, 1))
    half, side = TILE_SIDE / 2, TILE_SIDE
    below = [((3, 5), 3.5 * side), ((3, 3), 1.5 * side), ((3, 2), half), ((3, 1), 0.0)]  # straight to the goal's border
    for tile, metres in below:
        assert left(reward, tile) == pytest.approx(metres, abs=1e-6)
    # From the upper arm: to the first inner corner, one side down to the second, three sides along the lower arm.
    for column in (1, 2, 3, 4):
        to_corner = math.hypot(half, (4.5 - column) * side)
        assert left(reward, (1, column)) == pytest.approx(to_corner + side + 3 * side, abs=ERROR)
    # The straight path from the start is two tiles long.
    assert left(reward, (1, 1)) > 1.1 > 3 * side > 2 * side


def test_to_clear_is_the_distance_out_of_the_region_of_all_objects_together() -> None:
    tiles = [[row, column] for row in (1, 2, 3) for column in (2, 3, 4)]
    task = parse_task("clearing", {"region": tiles, "target_start": tiles, "obstacle_start": tiles})
    for margin in (0.0, 0.02):
        reward = TaskReward(task, margin=margin)
        out = 1.5 * TILE_SIDE + margin
        assert left(reward, (2, 3)) == pytest.approx(out, abs=SPACING)
        assert left(reward, (2, 3), (2, 2), (0, 0)) == pytest.approx(out + TILE_SIDE / 2 + margin, abs=2 * SPACING)
    centers = torch.tensor([[*tile_center((2, 3)), 0.03]] * 2)
    assert reward.distance_to_goal()(centers, torch.tensor([True, False])) == pytest.approx(
        out, abs=SPACING
    )  # without padding


def test_to_insert_is_the_distance_through_the_mouth_of_the_slot() -> None:
    reward = TaskReward(load_task("insertion", 0))  # the slot (2, 1) is open towards (2, 2)
    assert left(reward, (2, 3)) == pytest.approx(1.5 * TILE_SIDE, abs=SPACING)
    assert left(reward, (4, 2)) == pytest.approx(math.hypot(1.5 * TILE_SIDE, TILE_SIDE / 2), abs=ERROR)
