"""Policies without a model: the floors for learned planners."""

from __future__ import annotations

import math
from zlib import crc32

import numpy as np
import torch
from torch import Tensor

from cavin_pyro.envs.tabletop.observation import Observation, ObservedPoints
from cavin_pyro.envs.tabletop.policy import HeuristicPushingPolicy
from cavin_pyro.envs.tabletop.robots.robot import STICK_RADIUS
from cavin_pyro.envs.tabletop.tasks.reward import TaskReward
from cavin_pyro.envs.tabletop.workspace import POINTS_PER_OBJECT, normalised_push
from cavin_pyro.models.state import State

DIRECTIONS = 32
LENGTHS = (0.01, 0.02, 0.03, 0.04, 0.05, 0.06, 0.07)  # metres that an object is to move
GAP = 0.015  # metres from the tool to the object's nearest point where it touches down
CLEARANCE = 0.005  # metres from the tool to every other point there


class ScriptedPush:
    """Goes behind an object and pushes it the way that leaves the least to the goal, one push at a time.

    An object is taken to move straight on with the tool, and nothing else to move. What is left is the length of the
    layout's shortest way along allowed tiles, of all objects if the goal is about all. Pushes that would break a rule,
    begin out of reach or touch down on an object come last. It reads what planners read.
    """

    def __call__(self, state: State, reward: TaskReward, observed: ObservedPoints) -> Tensor:
        """The next normalised push `[1, 4]` in the scene `state: []`; `observed`: a batch of one.

        Raises ValueError for another world's reward.
        """
        if not isinstance(reward, TaskReward):
            raise ValueError("planner=scripted knows the ways of the tabletop alone: choose another planner here")
        remaining = reward.distance_to_goal()
        real = state.mask.nonzero()[:, 0]
        objects = len(real) if reward.about == "all" else 1
        clouds = observed.points[0].unflatten(0, (-1, POINTS_PER_OBJECT))[:objects]  # [O, 256, 2]
        centers = state.centers[real[:objects], :2]
        angles = 2 * math.pi / DIRECTIONS * torch.arange(DIRECTIONS)
        ways = torch.stack((angles.cos(), angles.sin()), -1)  # [D, 2]
        behind = -((clouds - centers[:, None]) @ ways.T).amin(1)  # [O, D] from the centre to the last point

        shape = objects, DIRECTIONS, len(LENGTHS)
        lengths = torch.tensor(LENGTHS)[:, None]
        starts = centers[:, None] - ways * (behind + STICK_RADIUS + GAP)[..., None]  # [O, D, 2]
        motions = ways[:, None] * (GAP + lengths)  # [D, L, 2]
        pushes = torch.from_numpy(
            normalised_push(starts[:, :, None].expand(*shape, 2).numpy(), motions.expand(*shape, 2).numpy())
        ).float()
        paths = state.centers.expand(*shape, 3, -1, -1).clone()  # before, half way, after
        for number, index in enumerate(real[:objects].tolist()):
            for point, share in ((1, 0.5), (2, 1.0)):
                paths[number, :, :, point, index, :2] += share * ways[:, None] * lengths

        mask = state.mask.expand(*shape, -1)
        outcome = reward.along(paths, mask)
        left = remaining(paths[..., 2, :, :], mask)
        success, failure = outcome.success.any(-1), outcome.failure.any(-1)
        landing = observed.blocked(pushes.reshape(1, -1, 4), STICK_RADIUS + CLEARANCE).reshape(shape)
        impossible = landing | (pushes.abs() > 1).any(-1)
        cost = left - 10.0 * success + 100.0 * failure + 1000.0 * impossible  # of metres on a table
        return pushes.flatten(0, 2)[cost.argmin()].clamp(-1, 1)[None]


class HeuristicPush:
    """Pushes an object as the policy that collects data, without a goal; what is seen decides which and how."""

    def __call__(self, state: State, reward: TaskReward, observed: ObservedPoints) -> Tensor:
        """The next normalised push `[1, 4]`; for arguments and errors see `ScriptedPush`."""
        if not isinstance(observed, ObservedPoints):
            raise ValueError("planner=heuristic pushes on the tabletop alone: choose another planner here")
        clouds = observed.points[0].unflatten(0, (-1, POINTS_PER_OBJECT)).numpy()  # [O, 256, 2]
        centers, seen = state.centers[state.mask].numpy(), np.ones(len(clouds), dtype=np.bool_)
        observation = Observation(clouds, centers, seen, seen)
        policy = HeuristicPushingPolicy(np.random.default_rng(crc32(clouds.tobytes())))
        return torch.from_numpy(policy.act(observation)).float()[None]
