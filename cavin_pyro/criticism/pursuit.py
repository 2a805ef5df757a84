"""Pursuing subgoals in physics: choose codes in a drawn scene, carry the pushes out in PyBullet, and look.

Letters: N candidates, T pushes, M objects.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.collection import crowd, open_scene
from cavin_pyro.criticism.section import Subject
from cavin_pyro.episodes import observed_state
from envs.objects import ObjectRanges
from envs.observation import Observation
from envs.scene import Scene
from envs.workspace import REACH_HIGH, REACH_LOW
from models.state import State
from planning.ranking import squared_distance
from planning.sampling import sample_each

GOAL_DISTANCE = 0.15  # metres; how far a chosen effect is to take the target
PHOTOGRAPH = (384, 318)  # pixels
# How the codes of a pursuit come about; "closest" and "given" are about motions.
DRAWN, CHOSEN, CLOSEST, GIVEN = "drawn", "chosen", "closest", "given"


class Choice(NamedTuple):
    """What is to be carried out, and what is to come of it."""

    actions: NDArray[np.float32]  # [T, 4] normalised
    subgoal: NDArray[np.float32] | None  # [M, 3] metres, by h
    predicted: NDArray[np.float32]  # [M, 3] metres, by f along the actions


@dataclass(frozen=True)
class Pursuit:
    """One choice, carried out in one scene.

    Attributes:
        scene: its number. effect, motion: how the codes were chosen.
        before, reached: [M, 3] metres, as seen before the first push and after the last.
        unsafe, ineffective: numbers of pushes that were not carried out, and that were and moved nothing.
        fallen: an object left the table, which ended the pushes. hidden: an object cannot be seen at the end.
        photograph: [height, width, 3] before the first push.
    """

    scene: int
    effect: str
    motion: str
    choice: Choice
    before: NDArray[np.float32]
    reached: NDArray[np.float32]
    unsafe: int
    ineffective: int
    fallen: bool
    hidden: bool
    photograph: NDArray[np.uint8]


def ways(codes: tuple[str, ...]) -> list[tuple[str, str]]:
    """Pairs (effect, motion) that a model with these codes can be asked for; none for a model without codes."""
    motions = {2: (DRAWN, CLOSEST), 1: (GIVEN,), 0: ()}[len(codes)]
    return [(effect, motion) for effect in (DRAWN, CHOSEN) for motion in motions]


def draw_scene(scene: Scene, ranges: ObjectRanges, seed: int, number: int, objects: int) -> Observation:
    """Scene `number` with so many objects, drawn as in collection; equal numbers give equal scenes."""
    generator = np.random.default_rng([seed, number])
    return scene.draw([crowd(generator)] * objects, ranges, generator)


def pursue(subject: Subject, *, scenes: int, objects: int, samples: int) -> Iterator[list[Pursuit]]:
    """In each scene, a pursuit per way of choosing; scene k depends on the seed and k alone.

    Args:
        samples: N, the candidates of those codes that are chosen.
    """
    scene = open_scene(subject.world)
    try:
        for number in range(scenes):
            yield [_pursuit(subject, scene, number, way, objects, samples) for way in ways(subject.codes)]
    finally:
        scene.close()


def _pursuit(subject: Subject, scene: Scene, number: int, way: tuple[str, str], objects: int, samples: int) -> Pursuit:
    seen = draw_scene(scene, subject.world.ranges, subject.seed, number, objects)
    state = observed_state({"centers": seen.centers, "clouds": seen.clouds, "mask": seen.mask}, subject.pointnet)
    goal = _goal(seen.centers[0], np.random.default_rng([subject.seed, number, 1]))
    choice = choose(subject, state, torch.from_numpy(goal), way, [subject.seed, number], samples)
    photograph = scene.photograph(scene.camera.resized(*PHOTOGRAPH))
    reports = []
    for action in choice.actions:
        reports.append(scene.push(np.clip(action, -1.0, 1.0)))
        if reports[-1].fallen:
            break
    after = scene.observe()
    return Pursuit(
        number,
        *way,
        choice=choice,
        before=seen.centers[:objects],
        reached=after.centers[:objects],
        unsafe=sum(report.unsafe for report in reports),
        ineffective=sum(report.ineffective and not report.unsafe for report in reports),
        fallen=reports[-1].fallen,
        hidden=not after.visible[:objects].all(),
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


@torch.inference_mode()
def choose(subject: Subject, state: State, goal: Tensor, way: tuple[str, str], seed: list[int], samples: int) -> Choice:
    """Choose codes for one scene `state: [1]` in one of the `ways`, and generate the pushes.

    An effect is drawn from the prior, or chosen: of N draws, the one whose subgoal (without h: the state that f
    predicts) brings object 0 closest to `goal: [2]` metres. A motion is drawn, or the closest of N to the subgoal
    by f, as in planning (paper, Algorithm 1, line 10); a model of one code has it given with the effect.
    """
    model, (effect, motion) = subject.model, way
    here, count = state.expand_plans(1), samples if effect == CHOSEN else 1
    plans = state.expand_plans(count)
    if "effect_code" not in subject.codes:
        code = sample_each(model.motion_prior, [plans], [_generator([*seed, 2])])
        actions = model.actions(here, motion_code=code)
        ends = _follow(subject, here, actions)
        best = int(_from_goal(ends, goal).argmin())
        return Choice(actions[0, best].numpy(), None, ends.centers[0, best].numpy())
    code = sample_each(model.effect_prior, [plans], [_generator([*seed, 2])])
    best = int(_from_goal(model.subgoal(here, code), goal).argmin())
    code = code[:, best : best + 1]
    subgoal = model.subgoal(here, code)
    if "motion_code" in subject.codes:
        plans = state.expand_plans(samples if motion == CLOSEST else 1)
        code = code.expand(*plans.batch_shape, -1)
        motion_code = sample_each(model.motion_prior, [plans, code], [_generator([*seed, 3])])
        actions = model.actions(here, effect_code=code, motion_code=motion_code)
    else:
        actions = model.actions(here, effect_code=code)
    ends = _follow(subject, here, actions)
    best = int(squared_distance(ends, subgoal).argmin())
    return Choice(actions[0, best].numpy(), subgoal.centers[0, 0].numpy(), ends.centers[0, best].numpy())


def _follow(subject: Subject, state: State, actions: Tensor) -> State:
    """Where f leads from `state: [1, 1]` along `actions: [1, N, T, 4]`: `[1, N]`."""
    for action in actions.unbind(-2):
        state = subject.model.next_state(state, action)
    return state


def _from_goal(states: State, goal: Tensor) -> Tensor:
    """Distance of object 0 from `goal: [2]` in the plane: `[...]` metres, from `states: [...]`."""
    return (states.centers[..., 0, :2] - goal).norm(dim=-1)


def _generator(seed: list[int]) -> torch.Generator:
    return torch.Generator().manual_seed(int(np.random.SeedSequence(seed).generate_state(1)[0]))
