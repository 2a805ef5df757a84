"""Arms that push, and what they have in common with the stick."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.robots.arm import inverse_kinematics
from cavin_pyro.envs.tabletop.robots.robot import ABOVE_HEIGHT, TIP_HEIGHT, push
from cavin_pyro.envs.tabletop.robots.sawyer import sawyer
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW
from tests.real_assets import REAL_ASSETS

NO_SAWYER = "the Sawyer's URDF lies neither in ../shared/assets nor where CAVIN_ASSETS says"
with_sawyer = pytest.mark.skipif(not (REAL_ASSETS / "sawyer" / "sawyer_stick.urdf").is_file(), reason=NO_SAWYER)
ARMS = [pytest.param("sawyer", marks=with_sawyer), "panda"]
EVERY_ROBOT = [*ARMS, "stick"]


@pytest.fixture(scope="module")
def scene_of() -> Callable[[str], Scene]:
    made: dict[str, Scene] = {}
    yield lambda name: made.setdefault(name, Scene(robot=name, assets=REAL_ASSETS))
    for scene in made.values():
        scene.close()


@pytest.mark.parametrize("name", ARMS)
@pytest.mark.parametrize("direction", [(0.08, 0.0), (-0.05, 0.06)])
def test_an_arm_pushes_an_object_to_where_the_stick_pushes_it(
    scene_of: Callable, put: Callable, push: Callable, name: str, direction: tuple[float, float]
) -> None:
    ends = []
    for robot in ("stick", name):
        scene = scene_of(robot)
        scene.reset([put("rubiks_cube", 0.55, 0.0), put("mug", 0.55, 0.3)], np.random.default_rng(0))
        way = np.array(direction) / np.linalg.norm(direction)
        report = scene.push(push(*(np.array([0.55, 0.0]) - 0.065 * way), *direction))
        assert (report.unsafe, report.ineffective, report.stopped) == (False, False, "")
        ends.append(scene.ground_truth().positions)
    assert np.linalg.norm(ends[0][0, :2] - (0.55, 0.0)) > 0.03
    np.testing.assert_allclose(ends[1], ends[0], atol=0.005)


@pytest.mark.parametrize("name", ARMS)
def test_the_tip_follows_its_line_with_the_sticks_profile(scene_of: Callable, put: Callable, name: str) -> None:
    scene = scene_of(name)
    heavy = replace(put("rubiks_cube", 0.55, 0.0), mass=10.0, friction=0.8)
    scene.reset([heavy], np.random.default_rng(0))
    robot, tips = scene.robot, []
    start, end = np.array([0.48, -0.03, TIP_HEIGHT]), np.array([0.58, 0.05, TIP_HEIGHT])
    assert robot.reaches(start, end)
    assert not robot.move(start + (0, 0, 0.2)) and not robot.move(start)
    scene.world.on_step = lambda: tips.append(robot.tip())
    assert robot.slide(end) == ""
    scene.world.on_step = None
    way = (1 - np.cos(np.linspace(0, np.pi, len(tips) + 1)))[1:, None] / 2
    off = np.linalg.norm(np.array(tips) - (start + way * (end - start)), axis=1)
    assert np.median(off) < 0.002 and off.max() < 0.005
    robot.leave()


@pytest.mark.parametrize("name", ARMS)
def test_an_arm_touches_nothing_on_its_way_between_retracted_and_above(
    scene_of: Callable, put: Callable, name: str
) -> None:
    scene = scene_of(name)
    tall = put("sugar_box", 0.5, 0.12, scale=1.2, orientation=(0.0, 0.0, 0.0, 1.0))
    scene.reset([tall, put("mug", 0.5, -0.12)], np.random.default_rng(0))
    robot, before, heights = scene.robot, scene.ground_truth(), []
    scene.world.on_step = lambda: heights.append(robot.tip()[2])
    for x, y in [(0.35, -0.3), (0.5, 0.12), (0.6, 0.3), (0.5, -0.12)]:
        assert robot.move(np.array([x, y, ABOVE_HEIGHT])) == ""
        robot.leave()
    scene.world.on_step = None
    assert min(heights) > 0.2
    after = scene.ground_truth()
    np.testing.assert_allclose(after.positions, before.positions, atol=1e-5)
    np.testing.assert_allclose(after.orientations, before.orientations, atol=1e-4)


@pytest.mark.parametrize("name", EVERY_ROBOT)
def test_a_push_onto_an_object_is_unsafe_under_every_robot(
    scene_of: Callable, put: Callable, push: Callable, name: str
) -> None:
    scene = scene_of(name)
    scene.reset([put("rubiks_cube", 0.55, 0.0), put("mug", 0.55, 0.2)], np.random.default_rng(0))
    before = scene.ground_truth()
    report = scene.push(push(0.55, 0.01, 0.1, 0.0))
    assert report.unsafe and report.ineffective and report.stopped == ""
    np.testing.assert_array_equal(scene.ground_truth().positions, before.positions)


def test_a_push_out_of_reach_is_not_begun(scene_of: Callable, put: Callable, push: Callable) -> None:
    scene = scene_of("panda")
    scene.reset([put("rubiks_cube", 0.75, 0.45)], np.random.default_rng(0))
    before = scene.ground_truth()
    report = scene.push(push(0.78, 0.53, -0.02, -0.02))
    assert report.stopped == "unreachable" and report.ineffective and not report.unsafe
    np.testing.assert_array_equal(scene.ground_truth().positions, before.positions)
    assert scene.push(push(0.5, 0.0, 0.05, 0.0)).stopped == ""  # and the next one is


@pytest.mark.parametrize("name", ARMS)
def test_a_push_against_what_cannot_move_is_blocked_and_ends_retracted(
    scene_of: Callable, put: Callable, push: Callable, name: str
) -> None:
    scene = scene_of(name)
    anvil = replace(put("rubiks_cube", 0.55, 0.0, scale=1.2), mass=1e6, friction=1.0)
    scene.reset([anvil], np.random.default_rng(0))
    report = scene.push(push(0.47, 0.0, 0.1, 0.0))
    assert report.stopped == "blocked" and report.moved[0] < 0.01
    assert scene.robot.clear_of_view(scene.sensor.nominal)
    assert scene.observe().visible[0]


class Deaf:
    """A robot that stops at one verb, to see that the push still ends retracted."""

    def __init__(self, verb: str) -> None:
        self.verb, self.called = verb, []

    def tip(self) -> np.ndarray:
        return np.array([0.5, 0.0, TIP_HEIGHT])

    def __getattr__(self, verb: str) -> Callable:
        def call(*arguments: object) -> object:
            self.called.append(verb)
            return True if verb in ("fits", "reaches") else "blocked" if verb == self.verb else ""

        return call


@pytest.mark.parametrize("verb", ["move", "slide"])
def test_whatever_stops_a_push_the_robot_goes_up_and_is_retracted(verb: str) -> None:
    robot = Deaf(verb)
    assert push(robot, np.array([0.5, 0.0]), np.array([0.6, 0.0])) == "blocked"
    assert robot.called[-3:] == ["stop", "move", "leave"]
    assert ("slide" in robot.called) == (verb == "slide")


@with_sawyer
@settings(max_examples=60)
@given(st.floats(REACH_LOW[0], REACH_HIGH[0]), st.floats(REACH_LOW[1], REACH_HIGH[1]))
def test_the_sawyer_reaches_every_place_and_holds_the_stick_upright(x: float, y: float) -> None:
    inverse = inverse_kinematics(sawyer(REAL_ASSETS))
    for height in (TIP_HEIGHT, ABOVE_HEIGHT):
        angles = inverse.angles(np.array([x, y, height]))
        assert angles is not None
        assert (inverse.forward.low <= angles).all() and (angles <= inverse.forward.high).all()
        found = inverse.forward(angles)
        np.testing.assert_allclose(found.position, [x, y, height], atol=2e-4)
        assert found.axis[2] < -0.999


def test_missing_files_are_named_in_one_line(tmp_path: Path) -> None:
    (tmp_path / "sawyer").mkdir()
    for text, message in (
        ("<robot", "is no URDF"),
        ('<robot><mesh filename="meshes/hand.stl"/></robot>', "needs meshes/hand.stl, which is not in "),
    ):
        (tmp_path / "sawyer" / "sawyer_stick.urdf").write_text(text)
        with pytest.raises(ValueError, match=message) as caught:
            Scene(robot="sawyer", assets=tmp_path)
        assert "\n" not in str(caught.value)
