"""Options of objects, and the ranges that they are sampled from."""

from __future__ import annotations

from pathlib import Path

import pytest

from cavin_pyro.config.composition import compose
from cavin_pyro.config.world import object_ranges
from envs.objects.sampling import ObjectRanges
from envs.objects.shapes import BUILTIN_NAMES

PUBLISHED = ObjectRanges(mass=(1.0, 1.0), kilograms=(10.0, 10.0), friction=(0.8, 0.8), target=("mug",), drop_height=0.2)


@pytest.mark.parametrize(
    ("overrides", "ranges"),
    [
        ([], ObjectRanges()),
        (["env/ranges=paper"], ObjectRanges()),
        (["env/ranges=published"], PUBLISHED),
        (["env/ranges=paper", "env.ranges.kilograms=[10,10]"], ObjectRanges(kilograms=(10, 10))),
        (["env.ranges.names=[mug,banana]", "env.ranges.mass=[1,1]"], ObjectRanges(("mug", "banana"), mass=(1, 1))),
    ],
)
def test_a_preset_sets_the_ranges_and_options_change_them(overrides: list[str], ranges: ObjectRanges) -> None:
    assert object_ranges(compose("plan", *overrides).env) == ranges


def test_collecting_packs_objects_closer_with_every_preset() -> None:
    for overrides in ([], ["env/ranges=published"]):
        assert object_ranges(compose("collect", *overrides).env).clearance == 0.12


def test_all_objects_of_a_folder_are_sampled_by_default(tiny_assets: Path) -> None:
    overrides = [f"env.assets={tiny_assets}", "env.objects="]
    scans, both = (object_ranges(compose("plan", overrides[0], overrides[1] + name).env) for name in ("ycb", "mixed"))
    assert scans.names == ("brick", "mug", "angle")
    assert both.names == (*BUILTIN_NAMES, "brick", "angle")
