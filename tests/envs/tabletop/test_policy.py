"""The heuristic pushing policy."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cavin_pyro.envs.tabletop.objects.sampling import Area, ObjectRanges
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.policy import START_CLEARANCE, HeuristicPushingPolicy
from cavin_pyro.envs.tabletop.robots.robot import STICK_RADIUS
from cavin_pyro.envs.tabletop.scene import Scene
from cavin_pyro.envs.tabletop.workspace import OBJECT_SLOTS, POINTS_PER_OBJECT, push_endpoints

SEEDS = st.integers(0, 2**32 - 1)
REACHABLE: Area = (((0.40, -0.40), (0.70, 0.40)),)


def blobs(seed: int, count: int = 3) -> Observation:
    """Discs of 3 cm radius within reach, with room between them: what a camera could see."""
    generator = np.random.default_rng(seed)
    places = [(x, y) for x in (0.42, 0.60) for y in (-0.40, -0.15, 0.10, 0.35)]
    clouds = np.zeros((OBJECT_SLOTS, POINTS_PER_OBJECT, 3), np.float32)
    for slot, place in enumerate(generator.permutation(places)[:count]):
        angle, radius = (
            generator.uniform(0, 2 * np.pi, POINTS_PER_OBJECT),
            0.03 * generator.random(POINTS_PER_OBJECT),
        )
        clouds[slot, :, 0] = place[0] + radius * np.cos(angle)
        clouds[slot, :, 1] = place[1] + radius * np.sin(angle)
        clouds[slot, :, 2] = 0.03
    mask = np.arange(OBJECT_SLOTS) < count
    return Observation(clouds, clouds.mean(axis=1), mask, mask)


@settings(deadline=None, max_examples=20)
@given(seed=SEEDS, count=st.integers(1, OBJECT_SLOTS))
def test_pushes_start_clear_of_every_object(seed: int, count: int) -> None:
    observed = blobs(seed, count)
    policy = HeuristicPushingPolicy(np.random.default_rng(seed))
    for _ in range(6):
        action = policy.act(observed)
        assert action.shape == (4,) and (np.abs(action) <= 1).all()
        start, _ = push_endpoints(action)
        assert np.linalg.norm(observed.centers[:count, :2] - start, axis=1).min() >= START_CLEARANCE == 0.05
        assert np.linalg.norm(observed.clouds[:count, ::4, :2] - start, axis=-1).min() >= STICK_RADIUS


@pytest.mark.parametrize("length", [1, 3, 5])
def test_target_and_angle_are_kept_for_the_length_of_an_intent(length: int) -> None:
    policy = HeuristicPushingPolicy(np.random.default_rng(0), intent_length=length)
    observed, intents = blobs(1), []
    for _ in range(6 * length):
        policy.act(observed)
        intents.append((policy.intent.target, policy.intent.angle))
    runs = [set(intents[first : first + length]) for first in range(0, len(intents), length)]
    assert all(len(run) == 1 for run in runs)
    assert len(set.union(*runs)) == 6
    assert len({target for target, _ in intents}) > 1


def test_most_pushes_move_something_and_few_are_unsafe() -> None:
    scene = Scene()
    reports = []
    for seed in range(12):
        sampling, acting = np.random.default_rng(seed).spawn(2)
        observed = scene.sample([REACHABLE] * 3, ObjectRanges(clearance=0.12), sampling)
        policy = HeuristicPushingPolicy(acting)
        for _ in range(5):
            reports.append(scene.push(policy.act(observed)))
            observed = scene.observe()
    scene.close()
    assert len(reports) == 60
    assert np.mean([not report.ineffective for report in reports]) >= 0.6
    assert np.mean([report.unsafe for report in reports]) <= 0.15
