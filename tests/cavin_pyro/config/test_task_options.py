"""From the options `task` and `tiles` to a task's class and fields."""

from __future__ import annotations

from importlib import resources

import pytest
from omegaconf import OmegaConf

from cavin_pyro.config.composition import compose
from cavin_pyro.config.world import task_of
from envs.tasks import TASKS
from envs.tasks.insertion import Insertion


def test_every_task_can_be_chosen_by_its_name() -> None:
    presets = resources.files("cavin_pyro.config") / "presets" / "task"
    assert {file.name.removesuffix(".yaml") for file in presets.iterdir()} == set(TASKS)
    for name, task in TASKS.items():
        assert task_of(compose("plan", f"task={name}"))[0] is task


def test_options_of_a_task_and_tiles_replace_fields_of_its_layout() -> None:
    kind, fields = task_of(compose("plan", "task=insertion", "tiles.goal=[[1,2]]", "+task.region=[[0,0]]"))
    assert kind is Insertion
    assert {name: value for name, value in fields.items() if value} == {"goal": [[1, 2]], "region": [[0, 0]]}


@pytest.mark.parametrize("name", sorted(TASKS))
def test_a_name_alone_will_do_in_python(name: str) -> None:
    assert task_of(OmegaConf.create({"task": name, "tiles": {}})) == (TASKS[name], {})
