"""The tasks, by name."""

from __future__ import annotations

from cavin_pyro.envs.tasks.clearing import Clearing
from cavin_pyro.envs.tasks.crossing import Crossing
from cavin_pyro.envs.tasks.gathering import Gathering
from cavin_pyro.envs.tasks.generated import GeneratedLayouts
from cavin_pyro.envs.tasks.insertion import Insertion
from cavin_pyro.envs.tasks.rearrange import Rearrange
from cavin_pyro.envs.tasks.reward import Outcome, TaskReward
from cavin_pyro.envs.tasks.task import Marking, Step, Task
from cavin_pyro.envs.tasks.tiles import TileSet

TASKS: dict[str, type[Task]] = {task.name: task for task in (Clearing, Crossing, Gathering, Insertion, Rearrange)}

__all__ = ["TASKS", "GeneratedLayouts", "Marking", "Outcome", "Step", "Task", "TaskReward", "TileSet"]
