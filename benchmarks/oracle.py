"""The simulator in place of f (Algorithm 1, lines 9 and 10), to see what f's errors cost; no robot can do so."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.pushing import PushingEnv
from cavin_pyro.planning.additions import Choice, FailureAvoidance, Guidance
from cavin_pyro.planning.protocol import SegmentRollout
from cavin_pyro.planning.returns import TrackingCost


@dataclass(frozen=True)
class Oracle(FailureAvoidance):
    """Compares the best motions by f again, at the same costs, by what they do in the simulator.

    An object's centre moves as its body does. A motion by which one falls comes last. simulated: how many motions.
    """

    simulated: int = 32
    env: ClassVar[PushingEnv]  # of the episode

    def rank(self, scores: Tensor, choice: Choice) -> Tensor:
        assert choice.effect is not None
        best = scores[0].topk(min(self.simulated, scores.shape[-1])).indices
        actions, before = choice.first_actions()[:, best], choice.scene.state.expand_plans(len(best))
        moved, fell = zip(*(self.simulate(pushes.numpy()) for pushes in actions[0]), strict=True)
        path = before.centers.unsqueeze(-3).repeat(1, 1, actions.shape[-2], 1, 1)
        path[..., : moved[0].shape[-2], :] += torch.from_numpy(np.stack(moved)).to(path.dtype)
        rollout = SegmentRollout(actions.flatten(2), actions, before._replace(centers=path[..., -1, :, :]), path)
        cost = TrackingCost(choice.effect.subgoals, choice.effect.segments, choice.distance)
        guided = Guidance().wrap_objective(cost, choice.scene, choice.effect)
        objective = self.wrap_objective(guided, choice.scene, choice.effect)
        found = objective.advance(objective.start(before), 0, before, rollout).returns
        return torch.full_like(scores, -torch.inf).index_copy(1, best, found.where(~torch.tensor(fell), -1e9))

    def simulate(self, pushes: NDArray[np.floating]) -> tuple[NDArray[np.float64], bool]:
        """How far bodies are after each of the pushes [T, 4], [T, M, 3] metres, and whether one fell."""
        scene, moved, fell = self.env.scene, [], False
        there = scene.ground_truth()
        for push in pushes:
            fell |= scene.push(push).fallen
            moved.append(scene.ground_truth().positions - there.positions)
        scene.world.restore(scene.bodies, there)
        return np.stack(moved), fell
