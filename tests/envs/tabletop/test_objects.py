"""Objects: builtin and random shapes, scans from a folder, and how they are sampled."""

from __future__ import annotations

import os
import platform
import re
import shutil
import subprocess
import tempfile
from collections.abc import Callable, Iterator
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.files import process_folder
from cavin_pyro.envs.tabletop.objects.object_sets import chosen, load_object_set
from cavin_pyro.envs.tabletop.objects.sampling import (
    WHOLE_TABLE,
    Area,
    ObjectParameters,
    ObjectRanges,
    arrange,
    sample_objects,
)
from cavin_pyro.envs.tabletop.objects.shapes import RANDOM_NAMES, Shape, builtin_shape, random_shape
from cavin_pyro.envs.tabletop.robots.robot import SETTLED_SPEED
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import TABLE_HIGH, TABLE_LOW

# Millimetres and grams as published with the YCB Object and Model Set (Calli et al. 2015): the sides of the
# boxes, smallest first; diameter and height of what is round; thickness and length of the banana.
BOXES = {
    "sugar_box": ((38, 89, 175), 514),
    "pudding_box": ((35, 89, 110), 187),
    "gelatin_box": ((28, 73, 85), 97),
    "potted_meat_can": ((50, 82, 97), 370),
    "rubiks_cube": ((57, 57, 57), 94),
}
ROUND = {
    "tomato_soup_can": ((66, 101), 349),
    "tuna_fish_can": ((85, 33), 171),
    "mug": ((80, 82), 118),
    "a_cups": ((55, 60), 13),
}
BANANA = ((36, 190), 66)
TOLERANCE = 2.0  # millimetres
ALL_NAMES = [*BOXES, *ROUND, "banana"]


def corners(shape: Shape) -> np.ndarray:
    """[V, 3] millimetres."""
    return 1000 * np.vstack([part.vertices for part in shape.parts])


@pytest.mark.parametrize("name", ALL_NAMES)
def test_objects_have_their_published_sizes_and_masses(name: str) -> None:
    shape, (sizes, mass) = builtin_shape(name), {**BOXES, **ROUND, "banana": BANANA}[name]
    points = corners(shape) if name != "mug" else corners(Shape(name, shape.parts[:-3], shape.mass))  # no handle
    sides = np.ptp(points, axis=0)
    if name in ROUND:
        middle = (points.min(axis=0) + points.max(axis=0))[:2] / 2
        found = [2 * np.linalg.norm(points[:, :2] - middle, axis=1).max(), sides[2]]
    else:
        found = sorted(sides) if name in BOXES else [sides[2], sides[0]]
    np.testing.assert_allclose(found, sizes, atol=TOLERANCE)
    assert shape.mass == pytest.approx(mass / 1000)


@pytest.mark.parametrize("name", ALL_NAMES)
def test_every_part_is_convex_and_watertight(name: str) -> None:
    for part in builtin_shape(name).parts:
        assert part.is_watertight and part.is_convex
        assert part.volume > 0


SHAPES = [random_shape(name) for name in RANDOM_NAMES]


def test_a_name_is_the_same_object_whatever_was_built_before() -> None:
    again = random_shape.__wrapped__(RANDOM_NAMES[57])
    for part, other in zip(again.parts, SHAPES[57].parts, strict=True):
        np.testing.assert_array_equal(part.vertices, other.vertices)
    assert again.mass == SHAPES[57].mass


def test_random_objects_fall_come_to_rest_and_stay_on_the_table() -> None:
    scene = Scene(object_set=load_object_set("random"))
    generator = np.random.default_rng(0)
    for _ in range(2):
        scene.sample([WHOLE_TABLE] * 5, ObjectRanges(names=RANDOM_NAMES, clearance=0.12), generator)
        truth = scene.ground_truth()
        assert scene.world.fastest(scene.bodies) < SETTLED_SPEED
        assert (truth.positions[:, 2] > 0.0).all()
    scene.close()


SEEDS = st.integers(0, 2**32 - 1)
TWO_TILES: Area = (((0.3, -0.2), (0.45, -0.05)), ((0.7, 0.2), (0.85, 0.35)))


def within(area: Area, point: np.ndarray) -> bool:
    return any((np.array(low) <= point).all() and (point <= np.array(high)).all() for low, high in area)


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS, count=st.integers(1, 5), clearance=st.floats(0.0, 0.18))
def test_arranged_objects_keep_their_distance_and_their_areas(seed: int, count: int, clearance: float) -> None:
    areas = [TWO_TILES, *[WHOLE_TABLE] * (count - 1)]
    positions = arrange(areas, clearance, np.random.default_rng(seed))
    assert positions.shape == (count, 2)
    assert all(within(area, point) for area, point in zip(areas, positions, strict=True))
    assert all(np.linalg.norm(one - other) >= clearance for one, other in combinations(positions, 2))


RANGES = ObjectRanges(names=("banana", "mug", "sugar_box"), scale=(0.9, 1.1), mass=(2.0, 3.0), friction=(0.6, 0.7))


@settings(deadline=None, max_examples=30)
@given(seed=SEEDS, count=st.integers(1, 5))
def test_parameters_lie_within_their_ranges(seed: int, count: int) -> None:
    sampled = sample_objects([WHOLE_TABLE] * count, RANGES, np.random.default_rng(seed))
    assert len(sampled) == count
    for one in sampled:
        shape = builtin_shape(one.name)
        assert one.name in RANGES.names
        assert 0.9 <= one.scale <= 1.1
        assert 2.0 * shape.mass <= one.mass <= 3.0 * shape.mass
        assert 0.6 <= one.friction <= 0.7
        assert np.linalg.norm(one.orientation) == pytest.approx(1.0)
        assert (np.array(TABLE_LOW) < one.position[:2]).all() and (np.array(TABLE_HIGH) > one.position[:2]).all()
    published = ObjectRanges(target=("mug",), kilograms=(10.0, 10.0), drop_height=0.2)
    first, *others = sample_objects([WHOLE_TABLE] * count, published, np.random.default_rng(seed))
    assert first.name == "mug" and all(one.mass == 10.0 and one.position[2] >= 0.2 for one in (first, *others))


@pytest.fixture(scope="module")
def scanned(tiny_assets: Path) -> Iterator[Scene]:
    world = Scene(object_set=load_object_set("ycb", tiny_assets))
    yield world
    world.close()


def test_a_name_without_its_set_means_the_object_of_every_set(tiny_assets: Path) -> None:
    mixed = load_object_set("mixed", tiny_assets)
    assert chosen(["mug", "ycb/brick", "banana"], mixed) == ("mug", "ycb/mug", "ycb/brick", "banana")
    with pytest.raises(ValueError, match=r"^unknown object 'fork': choose from sugar_box, .*, brick, angle$"):
        chosen(["mug", "fork"], mixed)


def test_a_scan_has_its_own_inertia_and_every_part_of_it_collides(scanned: Scene) -> None:
    upright = ObjectParameters("ycb/angle", 1.0, 0.2, 0.7, (0.5, 0.0, 0.06), (0.0, 0.0, 0.0, 1.0))
    scanned.reset([upright], np.random.default_rng(0))
    bullet = scanned.world.client
    inertia = bullet.getDynamicsInfo(scanned.bodies[0], -1)[2]
    np.testing.assert_allclose(inertia, scanned.object_set.asset("ycb/angle").inertia, rtol=1e-6)
    # A ray down beside the leg meets the foot, 6 cm lower than one down the leg: the hull of both would be met between.
    low, high = scanned.ground_truth().positions[0, 0] + np.array([0.02, -0.02])
    heights = [bullet.rayTest((x, 0.0, 0.5), (x, 0.0, -0.5))[0][3][2] for x in (low, high)]
    assert max(heights) - min(heights) == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: (folder / "angle_vhacd.obj").unlink(), "angle_vhacd.obj: No such file or directory"),
        (lambda folder: (folder / "meta.json").write_text('{"mug": {"mass": 1}}'), "damaged: KeyError('inertia_diag')"),
        (lambda folder: (folder / "meta.json").write_text("{}"), "meta.json lists no object"),
        (lambda folder: (folder / "mug_vhacd.obj").write_text("v 0 0 0\n"), "mug_vhacd.obj or mug.obj is cut"),
        (lambda folder: (folder / "mug_vhacd.obj").write_text("v nan 0 0\n"), "mug_vhacd.obj are no points in metres"),
    ],
)
def test_a_folder_that_lacks_something_gets_its_one_line(
    spoil: Callable[[Path], object], said: str, tiny_assets: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(tiny_assets / "ycb", tmp_path / "ycb")
    spoil(folder)
    with pytest.raises(ValueError, match=re.escape(said)) as caught:
        load_object_set("ycb", tmp_path)
    assert "\n" not in str(caught.value) and str(folder) in str(caught.value)


def test_folders_of_killed_processes_are_removed_and_no_others(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    ended = subprocess.Popen(["true"])
    ended.wait()
    here, name = f"cavin_pyro_meshes_{platform.node()}_", f"{ended.pid}_abc"
    others = [f"{here}{os.getpid()}_abc", f"{here}x_abc", f"cavin_pyro_meshes_elsewhere_{name}", f"mine_{name}"]
    for folder in (here + name, *others):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "mug.obj").touch()
    (tmp_path / f"{here}{ended.pid}_link").symlink_to(tmp_path / others[3])
    made = process_folder("meshes")
    assert {path.name for path in tmp_path.iterdir()} - {f"{here}{ended.pid}_link"} == {made.name, *others}
    assert (tmp_path / others[3] / "mug.obj").exists()
    monkeypatch.setattr(os, "getuid", lambda: -1)
    (tmp_path / (here + name)).mkdir()
    process_folder("meshes")
    assert (tmp_path / (here + name)).exists()  # another user's
