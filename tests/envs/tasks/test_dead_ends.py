"""Planners with a margin keep objects within the tool's reach until they have arrived."""

from __future__ import annotations

from collections.abc import Sequence

import pytest
import torch

from envs.layouts import load_task
from envs.tasks import TaskReward
from envs.tasks.clearing import Clearing
from envs.workspace import tile_center

Point = tuple[float, float]
# A region up to the robot's side of the table, x 0.22 to 0.52 and y -0.11 to 0.19. The tool reaches x from 0.30 on.
AT_THE_ROBOT = Clearing(region=[(0, 3), (0, 4), (1, 3), (1, 4)], target_start=[(1, 3)], obstacle_start=[(1, 4)])


def violates(before: Sequence[Point], after: Sequence[Point], margin: float) -> bool:
    states = (torch.tensor([[*point, 0.03] for point in points], dtype=torch.float64) for points in (before, after))
    mask = torch.ones(len(after), dtype=torch.bool)
    return bool(TaskReward(AT_THE_ROBOT, margin=margin)(*states, mask).violation)


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
    others: list[Point]
    for others in ([], [tile_center((1, 3))]):
        assert violates([before, *others], [after, *others], 0.02) == dead_end
        assert not violates([before, *others], [after, *others], 0.0)  # the environment forbids nothing


def test_a_region_that_the_tool_reaches_has_no_dead_ends() -> None:
    generator = torch.Generator().manual_seed(0)
    low, high = torch.tensor([0.3, -0.5, 0.0]), torch.tensor([0.8, 0.5, 0.1])
    before, after = (low + (high - low) * torch.rand(200, 2, 3, generator=generator) for _ in range(2))
    reward, mask = TaskReward(load_task("clearing", 1), margin=0.02), torch.ones(200, 2, dtype=torch.bool)
    assert not reward(before, after, mask).violation.any()
