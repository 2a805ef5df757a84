"""The heuristic pushing policy that collects data: random pushes that are likely to move something.

Source: paper section 3.3 ("a heuristic policy that randomly samples actions that are likely to have plausible
effects") and the published implementation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.robots.robot import STICK_RADIUS
from cavin_pyro.envs.tabletop.workspace import distance_to_path, normalised_push, push_endpoints

CANDIDATES = 2048  # pushes sampled at once
SPREAD = np.radians(45.0)  # radians; how far a push may turn from the base angle, either way
NOISE = 0.3  # on each normalised motion component
START_CLEARANCE = 0.05  # metres from every object's centre to a push's start
CLOUD_CLEARANCE = 0.005  # metres between the tool and every visible point where it touches down
NEAR = 0.01  # metres; margin between the tool and the target object along the push
CENTRAL_FRACTION = 0.7  # of pushes aim at the middle of the target; the others may just graze it
CENTRAL = 0.03  # metres between a push's path and the target's centre that count as aiming at its middle
COMPARED = 8  # valid pushes to compare, at most; the policy makes the one that goes farthest after it meets the target
PERTURBATION = 0.04  # metres; standard deviation of a perturbed push's start, on each axis
PROPOSALS = 20  # targets and angles sampled before the policy makes a uniformly random push instead


@dataclass
class Intent:
    """The common target and direction of a series of pushes, so that they add up to one effect.

    target: number of the object, -1 for a uniformly random push. angle: radians.
    """

    target: int
    angle: float


class HeuristicPushingPolicy:
    """Pushes one object in about one direction for `intent_length` pushes, then chooses another object and direction.

    Args:
        generator: all of the policy's randomness. intent_length: pushes that share a target and a base angle.
        perturbation_rate: fraction of pushes with a perturbed start, so that many of them touch down on an
            object, graze one or miss. A planner picks, among thousands of pushes, those with the best prediction;
            a dynamics model trained without failing pushes is too optimistic about them.
    """

    def __init__(
        self, generator: np.random.Generator, *, intent_length: int = 5, perturbation_rate: float = 0.0
    ) -> None:
        self._generator = generator
        self._intent_length, self._perturbation_rate = intent_length, perturbation_rate
        self._left = 0
        self.intent = Intent(0, 0.0)

    def act(self, observation: Observation) -> NDArray[np.float64]:
        """Choose the next normalised push [4] from an observation."""
        if self._left == 0:
            self._new_intent(observation)
        for _ in range(PROPOSALS):
            action = self._propose(observation)
            if action is not None:
                self._left -= 1
                if self._perturbation_rate > 0.0 and self._generator.random() < self._perturbation_rate:
                    start, _ = push_endpoints(action)
                    moved = start + self._generator.normal(scale=PERTURBATION, size=2)
                    action[:2] = np.clip(normalised_push(moved, np.zeros(2))[:2], -1.0, 1.0)
                return action
            self._new_intent(observation)
        action = self._generator.uniform(-1.0, 1.0, size=4)
        self.intent, self._left = Intent(-1, float(np.arctan2(action[3], action[2]))), 0
        return action

    def _new_intent(self, observation: Observation) -> None:
        target = int(self._generator.choice(np.flatnonzero(observation.mask)))
        self.intent = Intent(target, float(self._generator.uniform(-np.pi, np.pi)))
        self._left = self._intent_length

    def _propose(self, observation: Observation) -> NDArray[np.float64] | None:
        generator, target = self._generator, self.intent.target
        starts = generator.uniform(-1.0, 1.0, size=(CANDIDATES, 2))
        angles = self.intent.angle + generator.uniform(-SPREAD, SPREAD, size=CANDIDATES)
        motions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        motions = np.clip(motions + generator.uniform(-NOISE, NOISE, size=motions.shape), -1.0, 1.0)
        actions = np.concatenate([starts, motions], axis=-1)
        start, end = push_endpoints(actions)

        centers = observation.centers[observation.mask, :2]
        clear = (np.linalg.norm(start[:, None] - centers, axis=-1) >= START_CLEARANCE).all(axis=-1)
        cloud = observation.clouds[target, ::4, :2]
        center = observation.centers[target, :2]
        extent = np.linalg.norm(cloud - center, axis=-1).max()
        reach = STICK_RADIUS + NEAR
        central = generator.random() < CENTRAL_FRACTION
        close = clear & (distance_to_path(center, start, end) <= (CENTRAL if central else extent + reach))
        scene = observation.clouds[observation.mask][:, ::4, :2].reshape(-1, 2)
        wanted, travels = int(generator.integers(1, COMPARED + 1)), {}
        for candidate in np.flatnonzero(close):  # in the order of sampling, so that the first valid ones are unbiased
            path = start[None, candidate], end[None, candidate]
            touches = distance_to_path(cloud[:, None], *path).min() <= reach
            safe = np.linalg.norm(scene - start[candidate], axis=-1).min() >= STICK_RADIUS + CLOUD_CLEARANCE
            if touches and safe:
                travels[candidate] = _travel_after_contact(cloud, start[candidate], end[candidate])
            if len(travels) == wanted:
                break
        return actions[max(travels, key=travels.__getitem__)] if travels else None


def _travel_after_contact(cloud: NDArray[np.floating], start: NDArray[np.float64], end: NDArray[np.float64]) -> float:
    """Metres of the push after it first meets the cloud [P, 2]; 0 if it misses."""
    line = end - start
    length = max(float(np.linalg.norm(line)), 1e-6)
    along = (cloud - start) @ line / length
    across = np.abs((cloud - start) @ np.array([-line[1], line[0]]) / length)
    met = along[(across <= STICK_RADIUS) & (along >= 0.0)]
    return max(0.0, length - float(met.min())) if len(met) else 0.0
