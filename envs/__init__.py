"""What is real: the table, the objects on it, the robot that pushes, the camera above, the three tasks."""

import gymnasium

for _task in ("clearing", "insertion", "crossing"):
    gymnasium.register(
        id=f"cavin/{_task.capitalize()}-v0",
        entry_point="envs.pushing:PushingEnv",
        kwargs={"task": _task},
    )
