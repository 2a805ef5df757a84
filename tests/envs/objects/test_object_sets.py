"""Builtin shapes, scans from a folder, and both together."""

from __future__ import annotations

import json
import re
import shutil
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from hypothesis import given
from hypothesis import strategies as st

from envs.objects.object_sets import OBJECT_SETS, ObjectSet, chosen, load_object_set
from envs.objects.sampling import WHOLE_TABLE, ObjectParameters, ObjectRanges, sample_objects
from envs.objects.shapes import BUILTIN_NAMES, builtin_shape
from envs.pushing import PushingEnv
from envs.robots import SETTLED_SPEED
from envs.scene import FALLEN, Scene
from envs.workspace import TABLE_HIGH, TABLE_LOW

TINY = ("ycb/brick", "ycb/mug", "ycb/angle")
ALL = ObjectRanges(names=("brick", "mug", "angle"), clearance=0.12)


@pytest.fixture(scope="module")
def scans(tiny_assets: Path) -> ObjectSet:
    return load_object_set("ycb", tiny_assets)


@pytest.fixture(scope="module")
def scanned(scans: ObjectSet) -> Iterator[Scene]:
    world = Scene(object_set=scans)
    yield world
    world.close()


@pytest.fixture(scope="module")
def real(real_assets: Path) -> Iterator[Scene]:
    world = Scene(object_set=load_object_set("ycb", real_assets))
    yield world
    world.close()


def poses(scene: Scene) -> np.ndarray:
    """Positions and orientations [M, 7]."""
    truth = scene.ground_truth()
    return np.concatenate([truth.positions, truth.orientations], axis=1)


def history(scene: Scene, ranges: ObjectRanges, seed: int, pushes: int = 4) -> list[np.ndarray]:
    sampling, acting = np.random.default_rng(seed).spawn(2)
    states = [scene.sample([WHOLE_TABLE] * 4, ranges, sampling).clouds, poses(scene)]
    for _ in range(pushes):
        scene.push(acting.uniform(-1.0, 1.0, size=4))
        states += [scene.observe().clouds, poses(scene)]
    return states


# Names.


def test_each_set_has_its_objects(tiny_assets: Path) -> None:
    assert load_object_set("builtin").names == BUILTIN_NAMES
    assert load_object_set("ycb", tiny_assets).names == TINY
    assert load_object_set("mixed", tiny_assets).names == (*BUILTIN_NAMES, *TINY)


@pytest.mark.parametrize("word", OBJECT_SETS)
def test_an_object_is_known_by_the_name_that_it_is_asked_for_by(word: str, tiny_assets: Path) -> None:
    objects = load_object_set(word, tiny_assets)
    assert [objects.asset(name).name for name in objects.names] == list(objects.names)
    with pytest.raises(ValueError, match="^unknown object 'fork': choose from "):
        objects.asset("fork")


def test_a_name_without_its_set_means_the_object_of_every_set(tiny_assets: Path) -> None:
    mixed = load_object_set("mixed", tiny_assets)
    assert chosen(["mug", "ycb/brick", "banana"], mixed) == ("mug", "ycb/mug", "ycb/brick", "banana")
    with pytest.raises(ValueError, match=r"^unknown object 'fork': choose from sugar_box, .*, brick, angle$"):
        chosen(["mug", "fork"], mixed)


def test_what_is_held_out_is_never_sampled_and_all_else_is(tiny_assets: Path) -> None:
    mixed = load_object_set("mixed", tiny_assets)
    kept = tuple(name for name in BUILTIN_NAMES if name not in ("banana", "mug"))
    generator = np.random.default_rng(0)
    ranges = ObjectRanges(names=(*kept, "brick"))
    sampled = {one.name for _ in range(60) for one in sample_objects([WHOLE_TABLE] * 3, ranges, generator, mixed)}
    assert sampled == {*kept, "ycb/brick"}


def test_an_unknown_set_is_named_with_the_known_ones() -> None:
    with pytest.raises(ValueError, match=r"^unknown object set 'toys': choose from builtin, ycb, mixed, random$"):
        load_object_set("toys")


# What is sampled.


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 5))
def test_the_published_objects_are_heavy_and_dropped_and_the_target_is_the_mug(seed: int, count: int) -> None:
    ranges = ObjectRanges(target=("mug",), kilograms=(10.0, 10.0), drop_height=0.2)
    sampled = sample_objects([WHOLE_TABLE] * count, ranges, np.random.default_rng(seed))
    assert sampled[0].name == "mug"
    assert all(one.mass == 10.0 and one.position[2] >= 0.2 for one in sampled)


def test_a_target_of_its_own_leaves_the_other_objects_to_chance(scans: ObjectSet) -> None:
    ranges = ObjectRanges(names=("brick", "angle"), target=("mug",))
    generator = np.random.default_rng(0)
    samples = [sample_objects([WHOLE_TABLE] * 3, ranges, generator, scans) for _ in range(20)]
    assert {sampled[0].name for sampled in samples} == {"ycb/mug"}
    assert {one.name for sampled in samples for one in sampled[1:]} == {"ycb/brick", "ycb/angle"}


def test_inertia_grows_with_mass_and_area(scans: ObjectSet, tiny_assets: Path) -> None:
    published = json.loads((tiny_assets / "ycb" / "meta.json").read_text())["angle"]["inertia_diag"]
    asset = scans.asset("ycb/angle")
    np.testing.assert_allclose(asset.inertia_of(0.2, 1.0), published)
    np.testing.assert_allclose(asset.inertia_of(0.6, 2.0), 12.0 * np.array(published))
    assert load_object_set("builtin").asset("mug").inertia_of(1.0, 1.0) is None


# Physics.


def test_a_scan_has_its_own_inertia_and_every_part_of_it_collides(scanned: Scene) -> None:
    upright = ObjectParameters("ycb/angle", 1.0, 0.2, 0.7, (0.5, 0.0, 0.06), (0.0, 0.0, 0.0, 1.0))
    scanned.reset([upright], np.random.default_rng(0))
    bullet = scanned.world._bullet
    inertia = bullet.getDynamicsInfo(scanned.bodies[0], -1)[2]
    np.testing.assert_allclose(inertia, scanned.object_set.asset("ycb/angle").inertia, rtol=1e-6)
    # A ray down beside the leg meets the foot, 6 cm lower than one down the leg: the hull of both would be met between.
    low, high = scanned.ground_truth().positions[0, 0] + np.array([0.02, -0.02])
    heights = [bullet.rayTest((x, 0.0, 0.5), (x, 0.0, -0.5))[0][3][2] for x in (low, high)]
    assert max(heights) - min(heights) == pytest.approx(0.08, abs=0.005)


@pytest.mark.parametrize("seed", range(3))
def test_scans_rest_where_they_have_settled(scanned: Scene, seed: int) -> None:
    scanned.sample([WHOLE_TABLE] * 5, ALL, np.random.default_rng(seed))
    before = poses(scanned)
    assert scanned.world.fastest(scanned.bodies) < SETTLED_SPEED
    for _ in range(240):
        scanned.world.step()
    np.testing.assert_allclose(poses(scanned)[:, :3], before[:, :3], atol=0.001)


def test_equal_seeds_give_equal_states_with_parts_whatever_came_before(scanned: Scene, scans: ObjectSet) -> None:
    fresh = Scene(object_set=scans)
    first = history(fresh, ALL, seed=3)
    history(scanned, ALL, seed=4)
    again = history(scanned, ALL, seed=3)
    fresh.close()
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
    assert not np.array_equal(first[1], first[-1])


def test_an_environment_takes_all_that_is_in_the_folder(tiny_assets: Path) -> None:
    env = PushingEnv(object_set="ycb", assets=tiny_assets, objects=5)
    assert env.ranges.names == ("brick", "mug", "angle")
    check_env(env, skip_render_check=True)  # what it warns of is an error here
    first, _ = env.reset(seed=1)
    after, *_ = env.step(np.array([0.0, 0.0, 0.5, 0.5], np.float32))
    assert env.observation_space.contains(first) and env.observation_space.contains(after)
    assert {one.name for one in env.scene.objects} <= set(TINY)
    env.close()


# Assets that are not there.


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda folder: shutil.rmtree(folder), "meta.json cannot be read (No such file or directory)"),
        (lambda folder: (folder / "meta.json").unlink(), "meta.json cannot be read (No such file or directory)"),
        (lambda folder: (folder / "meta.json").write_text("{"), "meta.json is damaged: it is not JSON"),
        (lambda folder: (folder / "meta.json").write_text("{}"), "meta.json is damaged: it names no object"),
        (lambda folder: (folder / "mug.obj").unlink(), "incomplete: mug.obj missing"),
        (lambda folder: [(folder / file).unlink() for file in ("mug.obj", "angle_vhacd.obj")], "mug.obj and 1 more"),
        (lambda folder: (folder / "meta.json").write_text('{"../mug": {}}'), "incomplete: ../mug.obj"),
        (lambda folder: (folder / "meta.json").write_text('{"mug": {"mass": 1}}'), "mug needs a mass and an inertia"),
        (lambda folder: (folder / "meta.json").write_text("[" * 100_000), "meta.json is damaged: it is not JSON"),
        (lambda folder: (folder / "meta.json").write_text(f'{{"{"a" * 300}": {{}}}}'), "incomplete: aaa"),
        *(
            (lambda folder, values=values: tell_of_mug(folder, values), "mug needs a mass and an inertia_diag of three")
            for values in (
                {"mass": 0.1, "inertia_diag": 5},
                {"mass": 0.1, "inertia_diag": {"x": 1, "y": 1, "z": 1}},
                {"mass": True, "inertia_diag": [1, 1, 1]},
                {"mass": 0.1, "inertia_diag": [1, 1, True]},
                {"mass": 0.1, "inertia_diag": [1, 1]},
                {"mass": 0.1, "inertia_diag": [1, 1, float("nan")]},
                {"mass": 10**400, "inertia_diag": [1, 1, 1]},
                [0.1, 1, 1, 1],
            )
        ),
        (lambda folder: (folder / "mug_vhacd.obj").write_text("v nan 0 0\n"), "mug_vhacd.obj is damaged"),
        (lambda folder: (folder / "mug_vhacd.obj").write_text("v 0 0 1e999\nv 1 0 0\n"), "mug_vhacd.obj is damaged"),
        (lambda folder: (folder / "mug_vhacd.obj").write_text("v 0 0\n"), "mug_vhacd.obj is damaged"),
        (lambda folder: (folder / "mug_vhacd.obj").write_text(""), "mug_vhacd.obj is damaged"),
    ],
)
def test_a_folder_that_lacks_something_gets_its_one_line(
    spoil: Callable[[Path], object], said: str, tiny_assets: Path, tmp_path: Path
) -> None:
    folder = shutil.copytree(tiny_assets / "ycb", tmp_path / "ycb")
    spoil(folder)
    for word in ("ycb", "mixed"):
        with pytest.raises(ValueError, match=re.escape(said)) as caught:
            load_object_set(word, tmp_path)
        assert "\n" not in str(caught.value) and str(folder) in str(caught.value)
        assert said.startswith(("meta.json is damaged", "mug")) or "cavin_pyro.assets ycb --to" in str(caught.value)


def tell_of_mug(folder: Path, values: object) -> None:
    (folder / "meta.json").write_text(json.dumps({"mug": values}))


def test_the_folder_may_be_named_from_the_users_home(
    tiny_assets: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    shutil.copytree(tiny_assets, tmp_path / "mine")
    assert load_object_set("ycb", "~/mine").names == TINY
    with pytest.raises(ValueError, match="^no objects in .*meta.json cannot be read"):
        load_object_set("ycb", "~nobody-of-this-name/mine")


def test_without_a_folder_the_line_says_how_to_get_one() -> None:
    with pytest.raises(ValueError, match=r"give env.assets=DIR; get them with: python -m cavin_pyro.assets ycb --to"):
        load_object_set("ycb")


# The real ones.


def test_the_real_objects_are_the_papers_ten(real: Scene, real_assets: Path) -> None:
    objects = real.object_set
    assert {name.removeprefix("ycb/") for name in objects.names} == set(BUILTIN_NAMES)
    for name in BUILTIN_NAMES:
        asset = objects.asset(f"ycb/{name}")
        assert asset.mass == builtin_shape(name).mass
        assert asset.radius == pytest.approx(builtin_shape(name).radius, rel=0.15)
        inertia = ElementTree.parse(real_assets / "ycb" / f"{name}.urdf").find(".//inertia")
        assert asset.inertia == tuple(float(inertia.attrib[axis]) for axis in ("ixx", "iyy", "izz"))


def test_real_objects_are_pushed_and_none_sinks_or_flies(real: Scene) -> None:
    generator = np.random.default_rng(0)
    for seed in range(3):
        real.sample([WHOLE_TABLE] * 5, ObjectRanges(clearance=0.12), np.random.default_rng(seed))
        for _ in range(5):
            real.push(generator.uniform(-1.0, 1.0, size=4))
        for position in real.ground_truth().positions:
            on_table = (np.array(TABLE_LOW) < position[:2]).all() and (position[:2] < np.array(TABLE_HIGH)).all()
            assert position[2] > 0.0 if on_table else position[2] < FALLEN or position[2] > 0.0
            assert position[2] < 0.2


def test_equal_seeds_give_equal_states_with_real_objects(real: Scene, real_assets: Path) -> None:
    fresh = Scene(object_set=load_object_set("ycb", real_assets))
    first = history(fresh, ObjectRanges(clearance=0.12), seed=1)
    again = history(real, ObjectRanges(clearance=0.12), seed=1)
    fresh.close()
    for one, other in zip(first, again, strict=True):
        np.testing.assert_array_equal(one, other)
