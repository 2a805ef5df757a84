"""The tasks, by name: every class of a task in a file of this folder."""

from __future__ import annotations

import importlib
import pkgutil
from collections.abc import Mapping
from types import MappingProxyType

from envs.tasks.generated import GeneratedLayouts
from envs.tasks.reward import CRITERIA, REWARD_NAMES, Outcome, TaskReward
from envs.tasks.step import Step
from envs.tasks.task import GOAL_MARKING, Marking, Task
from envs.tasks.tiles import TileSet


def _tasks_in_this_folder() -> Mapping[str, type[Task]]:
    for module in pkgutil.iter_modules(__path__):
        importlib.import_module(f"{__name__}.{module.name}")
    return MappingProxyType({task.name: task for task in Task.__subclasses__()})


TASKS = _tasks_in_this_folder()

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
