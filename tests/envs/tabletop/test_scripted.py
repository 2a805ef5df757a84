"""The floors: the script that pushes towards the goal, and the heuristic."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cavin_pyro.envs.tabletop.layouts import parse_task
from cavin_pyro.envs.tabletop.observation import ObservedPoints
from cavin_pyro.envs.tabletop.scripted import GAP, LENGTHS, HeuristicPush, ScriptedPush
from cavin_pyro.envs.tabletop.tasks import TaskReward
from cavin_pyro.envs.tabletop.workspace import (
    POINTS_PER_OBJECT,
    REACH_HIGH,
    REACH_LOW,
    distance_to_path,
    push_endpoints,
    tile_center,
)
from cavin_pyro.models.state import State

BRIDGE = [[2, column] for column in range(1, 6)]
CROSSING = {"region": BRIDGE, "goal": [[2, 1]], "target_start": [[2, 5]], "obstacle_start": [[1, 3]]}
CLEARING = {"region": [[1, 3], [2, 3]], "target_start": [[1, 3]], "obstacle_start": [[2, 3]]}
RADIUS = 0.03


def scene(*places: tuple[float, float]) -> tuple[State, ObservedPoints]:
    """Discs at these places, and a slot of padding."""
    centers = torch.tensor([[x, y, 0.02] for x, y in places] + [[0.0, 0.0, 0.0]])
    angles = torch.linspace(0, 16 * torch.pi, POINTS_PER_OBJECT)  # a spiral to the rim and once around
    radii = RADIUS * torch.linspace(0, 8 / 7, POINTS_PER_OBJECT)[:, None].clamp(max=1)
    disc = radii * torch.stack((angles.cos(), angles.sin()), -1)
    points = (centers[:-1, None, :2] + disc).reshape(1, -1, 2)
    state = State(centers, torch.zeros(len(centers), 1), torch.arange(len(centers)) < len(places))
    return state, ObservedPoints(points, torch.tensor([REACH_LOW]), torch.tensor([REACH_HIGH]))


def pushed(name: str, layout: dict, *places: tuple[float, float]) -> tuple[torch.Tensor, torch.Tensor]:
    """Where the tool starts and ends, `[2]` metres each."""
    state, observed = scene(*places)
    action = ScriptedPush()(state, TaskReward(parse_task(name, layout)), observed)
    assert action.shape == (1, 4) and action.abs().max() <= 1
    start, end = push_endpoints(action[0].numpy())
    return torch.from_numpy(start), torch.from_numpy(end)


def test_the_target_is_pushed_along_the_bridge_from_behind() -> None:
    x, y = tile_center((2, 4))
    start, end = pushed("crossing", CROSSING, (x, y))
    assert start.tolist() == pytest.approx([x, y + RADIUS + 0.01 + GAP], abs=2e-3)
    assert (end - start).tolist() == pytest.approx([0.0, -(GAP + max(LENGTHS))], abs=2e-3)


def test_the_tool_does_not_land_on_another_object() -> None:
    x, y = tile_center((2, 4))
    behind = (x, y + 2 * RADIUS + 0.005)
    start, end = pushed("crossing", CROSSING, (x, y), behind)
    assert (start - torch.tensor(behind)).norm() > RADIUS + 0.01
    assert end[1] < start[1]


def test_to_clear_the_object_is_pushed_that_is_still_inside() -> None:
    outside, inside = tile_center((2, 5)), tile_center((1, 3))
    start, end = pushed("clearing", CLEARING, outside, inside)
    middle = (start + end) / 2 - torch.tensor(inside)
    assert middle.norm() < 0.06


def test_the_heuristic_pushes_an_object_and_the_scene_decides_how() -> None:
    reward = TaskReward(parse_task("crossing", CROSSING))
    pushes = []
    for x in (0.5, 0.5, 0.51):
        state, observed = scene((x, 0.1))
        pushes.append(HeuristicPush()(state, reward, observed))
        start, end = push_endpoints(pushes[-1][0].numpy())
        assert distance_to_path(np.array([x, 0.1]), start, end) < RADIUS + 0.03
    assert torch.equal(pushes[0], pushes[1]) and not torch.equal(pushes[0], pushes[2])
    with pytest.raises(ValueError, match=r"^planner=heuristic pushes on the tabletop alone"):
        HeuristicPush()(state, reward, None)
