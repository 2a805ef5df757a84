"""Subgoals in physics: plan a segment in a sampled scene, execute its pushes in PyBullet, and observe the result."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.segment_plan import SegmentPlan, code_selections, plan_segment
from cavin_pyro.data.collection import clutter_area, open_scene
from cavin_pyro.data.observed import observed_points, observed_state
from envs.objects.sampling import ObjectRanges
from envs.observation import Observation
from envs.scene import Scene
from envs.workspace import REACH_HIGH, REACH_LOW

GOAL_DISTANCE = 0.15  # metres; how far a selected effect should move the target
PHOTOGRAPH = (384, 318)  # pixels


@dataclass(frozen=True)
class SubgoalRollout:
    """A plan of one segment, executed in one scene.

    Attributes:
        scene: its number. effect, motion: how the codes were obtained.
        before, reached: [M, 3] metres, as observed before the first push and after the last.
        unsafe, ineffective: numbers of pushes that were not executed, and that were executed and moved nothing.
        fallen: an object left the table, which ended the rollout. hidden: an object is not visible at the end.
        photograph: [height, width, 3] before the first push.
    """

    scene: int
    effect: str
    motion: str
    plan: SegmentPlan
    before: NDArray[np.float32]
    reached: NDArray[np.float32]
    unsafe: int
    ineffective: int
    fallen: bool
    hidden: bool
    photograph: NDArray[np.uint8]


def sample_scene(scene: Scene, ranges: ObjectRanges, seed: int, number: int, objects: int) -> Observation:
    """Sample scene `number` with so many objects, as cluttered as in collection; equal numbers give equal scenes."""
    generator = np.random.default_rng([seed, number])
    return scene.sample([clutter_area(generator)] * objects, ranges, generator)


def subgoal_rollouts(
    context: CheckContext, *, scenes: int, objects: int, samples: int
) -> Iterator[list[SubgoalRollout]]:
    """In each scene, one rollout per way to obtain the codes; scene k depends on the seed and k alone.

    Args:
        samples: N, the number of candidates for a code that is chosen.
    """
    scene = open_scene(context.world)
    try:
        for number in range(scenes):
            yield [
                _rollout(context, scene, number, selection, objects, samples)
                for selection in code_selections(context.codes)
            ]
    finally:
        scene.close()


def _rollout(
    context: CheckContext, scene: Scene, number: int, selection: tuple[str, str], objects: int, samples: int
) -> SubgoalRollout:
    first = sample_scene(scene, context.world.ranges, context.seed, number, objects)
    seen = {"centers": first.centers, "clouds": first.clouds, "mask": first.mask}
    state, points = observed_state(seen, context.geometry), observed_points(seen)
    goal = _goal(first.centers[0], np.random.default_rng([context.seed, number, 1]))
    plan = plan_segment(context, state, torch.from_numpy(goal), selection, [context.seed, number], samples, points)
    photograph = scene.photograph(scene.camera.resized(*PHOTOGRAPH))
    reports = []
    for action in plan.actions:
        reports.append(scene.push(np.clip(action, -1.0, 1.0)))
        if reports[-1].fallen:
            break
    last = scene.observe()
    return SubgoalRollout(
        number,
        *selection,
        plan=plan,
        before=first.centers[:objects],
        reached=last.centers[:objects],
        unsafe=sum(report.unsafe for report in reports),
        ineffective=sum(report.ineffective and not report.unsafe for report in reports),
        fallen=reports[-1].fallen,
        hidden=not last.visible[:objects].all(),
        photograph=photograph,
    )


def _goal(target: NDArray[np.float32], generator: np.random.Generator) -> NDArray[np.float32]:
    """A point (x, y) metres for the target at `GOAL_DISTANCE`, within the tool's reach if a few attempts find one."""
    for _ in range(20):
        angle = generator.uniform(-np.pi, np.pi)
        goal = target[:2] + GOAL_DISTANCE * np.array([np.cos(angle), np.sin(angle)])
        if (goal > REACH_LOW).all() and (goal < REACH_HIGH).all():
            break
    return goal.astype(np.float32)
