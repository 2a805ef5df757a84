from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from envs.appearance import Part, parts_of
from envs.physics import PhysicsWorld
from envs.pushing import PushingEnv
from envs.robots import STICK_LENGTH, STICK_RADIUS
from envs.workspace import TABLE_HIGH, TABLE_LOW


def in_world(part: Part, world: PhysicsWorld) -> np.ndarray:
    """The part's vertices [V, 3] metres where they are now."""
    pose = world.link_poses([(part.body, part.link)])
    return Rotation.from_quat(pose.orientations[0]).apply(part.vertices) + pose.positions[0]


def test_every_body_is_drawn_where_the_camera_sees_it() -> None:
    env = PushingEnv(task="crossing", objects=5)
    observation, _ = env.reset(seed=3)
    world = env.scene.world
    parts = {part.body: part for part in parts_of(world)}
    assert len(parts) == 7  # the table, five objects and the tool
    for slot, body in enumerate(env.scene.bodies):
        vertices, cloud = in_world(parts[body], world), observation["clouds"][slot]
        # The camera's pixels are 5 mm wide on the table.
        assert (cloud > vertices.min(axis=0) - 0.006).all()
        assert (cloud < vertices.max(axis=0) + 0.006).all()
        assert cloud[:, 2].max() == pytest.approx(vertices[:, 2].max(), abs=0.006)
    env.close()


def test_table_and_tool_have_their_sizes() -> None:
    env = PushingEnv(task="crossing", objects=1)
    env.reset(seed=0)
    table, _, tool = parts_of(env.scene.world)
    corners = in_world(table, env.scene.world)
    np.testing.assert_allclose(corners[:, :2].min(axis=0), TABLE_LOW, atol=1e-6)
    np.testing.assert_allclose(corners[:, :2].max(axis=0), TABLE_HIGH, atol=1e-6)
    assert corners[:, 2].max() == pytest.approx(0.0, abs=1e-6)
    np.testing.assert_allclose(np.ptp(tool.vertices, axis=0), [2 * STICK_RADIUS] * 2 + [STICK_LENGTH], rtol=0.02)
    env.close()


def test_rendering_the_world_does_not_change_it() -> None:
    observed = []
    for looked in (False, True):
        env = PushingEnv(task="clearing", objects=3)
        env.reset(seed=1)
        if looked:
            world = env.scene.world
            links = [(part.body, part.link) for part in parts_of(world)]
            env.scene.on_frame = lambda world=world, links=links: world.link_poses(links)
        pushes = np.random.default_rng(0).uniform(-1, 1, (8, 4)).astype(np.float32)
        observed.append([env.step(push)[0]["clouds"] for push in pushes])
        env.close()
    np.testing.assert_array_equal(*observed)
