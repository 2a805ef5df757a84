"""The world: the table, the objects on it, the robot that pushes, the camera above, the tasks."""

import gymnasium

from cavin_pyro.envs.tabletop.tasks import TASKS

for _name in TASKS:
    gymnasium.register(
        id=f"cavin/{_name.capitalize()}-v0",
        entry_point="cavin_pyro.envs.tabletop.pushing:PushingEnv",
        kwargs={"task": _name},
    )
gymnasium.register(
    id="cavin/Pushing-v0", entry_point="cavin_pyro.envs.tabletop.pushing:PushingEnv"
)  # with PushingEnv's arguments
