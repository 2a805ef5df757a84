"""The tasks, by name."""

from __future__ import annotations

from cavin_pyro.envs.tabletop.tasks.clearing import Clearing
from cavin_pyro.envs.tabletop.tasks.crossing import Crossing
from cavin_pyro.envs.tabletop.tasks.generated import GeneratedLayouts
from cavin_pyro.envs.tabletop.tasks.insertion import Insertion
from cavin_pyro.envs.tabletop.tasks.rearrange import Rearrange
from cavin_pyro.envs.tabletop.tasks.reward import Outcome, TaskReward
from cavin_pyro.envs.tabletop.tasks.task import Marking, Step, Task
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet

TASKS: dict[str, type[Task]] = {task.name: task for task in (Clearing, Crossing, Insertion, Rearrange)}

__all__ = ["TASKS", "GeneratedLayouts", "Marking", "Outcome", "Step", "Task", "TaskReward", "TileSet"]
