"""The tasks, by name."""

from __future__ import annotations

from envs.tasks.clearing import Clearing
from envs.tasks.crossing import Crossing
from envs.tasks.gathering import Gathering
from envs.tasks.generated import GeneratedLayouts
from envs.tasks.insertion import Insertion
from envs.tasks.rearrange import Rearrange
from envs.tasks.reward import CRITERIA, REWARD_NAMES, Outcome, TaskReward
from envs.tasks.task import GOAL_MARKING, Marking, Step, Task
from envs.tasks.tiles import TileSet

TASKS: dict[str, type[Task]] = {task.name: task for task in (Clearing, Crossing, Gathering, Insertion, Rearrange)}

__all__ = [
    "CRITERIA",
    "GOAL_MARKING",
    "REWARD_NAMES",
    "TASKS",
    "GeneratedLayouts",
    "Marking",
    "Outcome",
    "Step",
    "Task",
    "TaskReward",
    "TileSet",
]
