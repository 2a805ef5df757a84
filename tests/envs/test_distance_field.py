"""The remaining distance to the goal, against distances measured by hand."""

from __future__ import annotations

import math

import pytest
import torch

from envs.layouts import load_task, parse_task
from envs.tasks import TASKS, TaskReward
from envs.tasks.tiles import SPACING, DistanceField, grid
from envs.workspace import TABLE_HIGH, TABLE_LOW, TILE_SIDE, Tile, tile_center

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
    return float(reward.distance_to_goal(centers, torch.ones(len(places), dtype=torch.bool)))


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
    assert reward.distance_to_goal(centers, torch.tensor([True, False])) == pytest.approx(
        out, abs=SPACING
    )  # without padding


def test_to_insert_is_the_distance_through_the_mouth_of_the_slot() -> None:
    reward = TaskReward(load_task("insertion", 0))  # the slot (2, 1) is open towards (2, 2)
    assert left(reward, (2, 3)) == pytest.approx(1.5 * TILE_SIDE, abs=SPACING)
    assert left(reward, (4, 2)) == pytest.approx(math.hypot(1.5 * TILE_SIDE, TILE_SIDE / 2), abs=ERROR)


def test_where_each_object_has_its_own_place_it_is_the_distance_to_that() -> None:
    tiles = {"region": [[2, 3]], "target_start": [[2, 3]], "obstacle_start": [[2, 3]]}
    task = parse_task("rearrange", {**tiles, "places": [tile_center((1, 1)), tile_center((3, 5))]})
    assert left(TaskReward(task), (1, 1), (3, 4)) == pytest.approx(TILE_SIDE)
    assert left(TaskReward(task), (3, 5), (1, 1)) == pytest.approx(2 * TILE_SIDE * math.hypot(2, 4))


@pytest.mark.parametrize("name", [name for name, task in TASKS.items() if task.goal_is_shared])
def test_the_distance_is_zero_where_the_task_is_solved_and_nowhere_longer_than_it_says(name: str) -> None:
    reward = TaskReward(load_task(name, 0), margin=0.02)
    torch.manual_seed(0)
    low, high = torch.tensor(TABLE_LOW), torch.tensor(TABLE_HIGH)
    planar = low + (high - low) * torch.rand(4000, 1, 2)
    centers, mask = torch.cat([planar, torch.zeros(4000, 1, 1)], -1), torch.ones(4000, 1, dtype=torch.bool)
    distances = reward.distance_to_goal(centers, mask)
    solved = reward(centers, centers, mask).success
    assert solved.any() and distances[solved].max() <= SPACING
    assert distances[~solved].mean() > SPACING
    assert (distances >= 0).all() and (distances <= reward.distance_to_goal.longest(mask)).all()


def test_places_off_the_table_and_predictions_that_are_not_finite_have_a_distance() -> None:
    reward = crossing(U, (3, 1))
    far = torch.tensor([[[9.0, -9.0, 0.0]], [[torch.nan, 0.0, 0.0]], [[torch.inf, -torch.inf, 0.0]]])
    distances = reward.distance_to_goal(far, torch.ones(3, 1, dtype=torch.bool))
    assert torch.isfinite(distances).all() and (distances >= 0).all()


def test_without_a_goal_there_is_no_direction() -> None:
    nowhere = torch.zeros(grid().shape[:-1], dtype=torch.bool)
    field = DistanceField(~nowhere, nowhere)
    assert field.longest == 0.0 and not field(torch.rand(5, 2)).any()
