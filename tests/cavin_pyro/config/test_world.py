"""From the options `task`, `tiles` and `env.*` to a task's class, its fields and ranges of objects."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.world import object_ranges, task_of
from cavin_pyro.envs.tabletop.objects.sampling import ObjectRanges
from cavin_pyro.envs.tabletop.objects.shapes import BUILTIN_NAMES
from cavin_pyro.envs.tabletop.tasks.insertion import Insertion

PUBLISHED = ObjectRanges(mass=(1.0, 1.0), kilograms=(10.0, 10.0), friction=(0.8, 0.8), target=("mug",), drop_height=0.2)


def test_options_of_a_task_and_tiles_replace_fields_of_its_layout() -> None:
    kind, fields = task_of(compose("plan", "task=insertion", "tiles.goal=[[1,2]]", "+task.region=[[0,0]]"))
    assert kind is Insertion
    assert {name: value for name, value in fields.items() if value} == {"goal": [[1, 2]], "region": [[0, 0]]}


@pytest.mark.parametrize("target", ["inf", "my_lab.Nothing", "builtins.dict"])
def test_what_is_no_task_is_named(target: str) -> None:
    with pytest.raises(UserError, match="Error loading|is no task: "):
        task_of(compose("plan", f"task._target_={target}"))


@pytest.mark.parametrize(
    ("overrides", "ranges"),
    [
        ([], ObjectRanges()),
        (["env/ranges=published"], PUBLISHED),
        (["env.ranges.kilograms=[10,10]"], ObjectRanges(kilograms=(10, 10))),
        (["env.ranges.names=[mug,banana]", "env.ranges.mass=[1,1]"], ObjectRanges(("mug", "banana"), mass=(1, 1))),
    ],
)
def test_a_preset_sets_the_ranges_and_options_change_them(overrides: list[str], ranges: ObjectRanges) -> None:
    assert object_ranges(compose("plan", *overrides).env) == ranges
    assert object_ranges(compose("collect", *overrides).env).clearance == 0.12  # with every preset


@pytest.mark.parametrize(
    "override", ["names=[fork]", "names=[]", "target=[fork]", "mass=[2,1]", "scale=[0.01,1]", "friction=[0.5]"]
)
def test_ranges_that_make_no_sense_are_named(override: str) -> None:
    with pytest.raises(UserError, match=rf"ranges\.{override.partition('=')[0]}\b"):
        object_ranges(compose("plan", f"env.ranges.{override}").env)


def test_all_objects_of_a_folder_are_sampled_by_default(tiny_assets: Path) -> None:
    overrides = [f"env.assets={tiny_assets}", "env.objects="]
    scans, both = (object_ranges(compose("plan", overrides[0], overrides[1] + name).env) for name in ("ycb", "mixed"))
    assert scans.names == ("brick", "mug", "angle")
    assert both.names == (*BUILTIN_NAMES, "brick", "angle")
