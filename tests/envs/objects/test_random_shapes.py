"""A hundred random shapes."""

from __future__ import annotations

import numpy as np
import pytest

from envs.objects.object_sets import load_object_set
from envs.objects.random_shapes import DENSITY, MAXIMUM_PARTS, RADIUS, RANDOM_NAMES, random_shape
from envs.objects.sampling import WHOLE_TABLE, ObjectRanges, sample_objects
from envs.objects.shapes import BUILTIN_NAMES, builtin_shape
from envs.robots import SETTLED_SPEED
from envs.scene import Scene

SHAPES = [random_shape(name) for name in RANDOM_NAMES]


def test_there_are_a_hundred_of_one_to_three_parts() -> None:
    assert len({shape.name for shape in SHAPES}) == 100
    assert {len(shape.parts) for shape in SHAPES} == set(range(1, MAXIMUM_PARTS + 1))


def test_every_part_is_a_closed_convex_body() -> None:
    assert all(part.is_watertight and part.is_convex for shape in SHAPES for part in shape.parts)


def test_parts_of_one_object_hold_together() -> None:
    for shape in SHAPES:
        for one, next_one in zip(shape.parts, shape.parts[1:], strict=False):
            # The middle of the next part lies on the surface of the one before: not above any of its faces' planes.
            above = one.face_normals @ next_one.bounds.mean(axis=0) - (one.face_normals * one.triangles[:, 0]).sum(1)
            assert above.max() < np.linalg.norm(next_one.extents) / 2


def test_they_are_as_large_and_as_heavy_as_the_real_ones() -> None:
    real = [builtin_shape(name) for name in BUILTIN_NAMES]
    assert min(RADIUS) <= min(shape.radius for shape in real)
    radii, masses = np.array([shape.radius for shape in SHAPES]), np.array([shape.mass for shape in SHAPES])
    assert ((radii >= RADIUS[0]) & (radii <= RADIUS[1])).all()
    volumes = np.array([sum(part.volume for part in shape.parts) for shape in SHAPES])
    assert ((masses / volumes >= DENSITY[0]) & (masses / volumes <= DENSITY[1])).all()
    assert min(shape.mass for shape in real) < np.median(masses) < max(shape.mass for shape in real)


def test_the_origin_is_the_centre_of_volume() -> None:
    for shape in SHAPES:
        volumes = np.array([part.volume for part in shape.parts])
        centers = np.array([part.center_mass for part in shape.parts])
        np.testing.assert_allclose(volumes @ centers / volumes.sum(), 0.0, atol=1e-9)


def test_a_name_is_the_same_object_whatever_was_built_before() -> None:
    again = random_shape.__wrapped__(RANDOM_NAMES[57])
    for part, other in zip(again.parts, SHAPES[57].parts, strict=True):
        np.testing.assert_array_equal(part.vertices, other.vertices)
    assert again.mass == SHAPES[57].mass


def test_an_unknown_one_is_refused_in_one_line() -> None:
    with pytest.raises(ValueError, match=r"^unknown object 'random/mug': choose from random/shape_00, .*, \.\.\., "):
        random_shape("random/mug")


def test_they_fall_come_to_rest_and_stay_on_the_table() -> None:
    scene = Scene(object_set=load_object_set("random"))
    generator = np.random.default_rng(0)
    for _ in range(6):
        scene.sample([WHOLE_TABLE] * 5, ObjectRanges(names=RANDOM_NAMES, clearance=0.12), generator)
        truth = scene.ground_truth()
        assert scene.world.fastest(scene.bodies) < SETTLED_SPEED
        assert (truth.positions[:, 2] > 0.0).all()
    scene.close()


def test_ranges_choose_among_them() -> None:
    objects = load_object_set("random")
    sampled = sample_objects([WHOLE_TABLE] * 3, ObjectRanges(names=("shape_07",)), np.random.default_rng(0), objects)
    assert [one.name for one in sampled] == ["random/shape_07"] * 3
