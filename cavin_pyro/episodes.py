"""Closing the loop: observe, plan, push T times, and again (paper, Algorithm 1, lines 3, 4, 11 and 12)."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from envs.pushing import ObservationDict, PushingEnv
from envs.randomness import planner_seed
from models.pointnet import PointNet
from models.state import State
from planning import Plan, Planner

OUTCOMES = ("success", "violation", "fall", "timeout")


@dataclass(frozen=True)
class Decision:
    """One plan, and what it was made from. Of its pushes T are made, or fewer (`run_episode`).

    Attributes:
        step: pushes made before. centers: [M, 3] metres and mask: [M], as observed. plan: for one environment.
        milliseconds: from the observation to the plan. photograph: [height, width, 3] for figures, if wanted.
        clouds: [M, 256, 3] metres, as observed, of real objects; None where nobody draws them.
    """

    step: int
    centers: NDArray[np.float32]
    mask: NDArray[np.bool_]
    plan: Plan
    milliseconds: float
    photograph: NDArray[np.uint8] | None = None
    clouds: NDArray[np.float32] | None = None


@dataclass(frozen=True)
class Push:
    """One executed push: the action [4], what followed, and where the objects [M, 3] were seen afterwards.

    subgoal_distance: metres, the mean over objects from where they are to where the plan's first subgoal wanted them;
    NaN before a segment's last push and for planners without subgoals.
    """

    step: int
    action: NDArray[np.float32]
    reward: float
    success: bool
    violation: bool
    fall: bool
    unsafe: bool
    ineffective: bool
    centers: NDArray[np.float32]
    subgoal_distance: float


@dataclass
class Episode:
    """What happened in one episode. outcome: one of `OUTCOMES`; photograph, clouds: as of `Decision`, at the end."""

    seed: int
    outcome: str = "timeout"
    decisions: list[Decision] = field(default_factory=list)
    pushes: list[Push] = field(default_factory=list)
    photograph: NDArray[np.uint8] | None = None
    clouds: NDArray[np.float32] | None = None

    @property
    def total_reward(self) -> float:
        """The episode's return."""
        return sum(push.reward for push in self.pushes)

    def reached(self, decision: Decision) -> NDArray[np.float32]:
        """Where the objects were seen after each push of a decision: [n, M, 3] metres, n <= T."""
        later = [other.step for other in self.decisions if other.step > decision.step]
        pushes = self.pushes[decision.step : min(later, default=len(self.pushes))]
        return np.array([push.centers for push in pushes], dtype=np.float32).reshape(-1, *decision.centers.shape)


@torch.inference_mode()
def observed_state(observation: ObservationDict, pointnet: PointNet) -> State:
    """The planner's state, a batch of one, from what the camera saw, without padding that nobody needs.

    Args:
        observation: as of `envs.pushing.PushingEnv`, [M, ...].
    """
    objects = int(np.flatnonzero(observation["mask"]).max(initial=0)) + 1
    centers = torch.from_numpy(observation["centers"][:objects])
    clouds = torch.from_numpy(observation["clouds"][:objects]) - centers[:, None]
    mask = torch.from_numpy(observation["mask"][:objects].astype(np.bool_))
    return State(centers[None], pointnet(clouds)[None], mask[None])


def run_episode(
    env: PushingEnv,
    planner: Planner,
    pointnet: PointNet,
    *,
    seed: int,
    pushes_per_plan: int | None = None,
    photograph: bool = False,
    on_decision: Callable[[Decision], None] | None = None,
    on_observation: Callable[[ObservationDict], None] | None = None,
) -> Episode:
    """Run one episode from depth images alone.

    Args:
        seed: of the scene; the planner's randomness is derived from it and independent of the scene's.
        pushes_per_plan: made before the next plan; None makes all T (paper, Algorithm 1, line 11).
        photograph: keep a picture with every decision.
        on_decision: called after every plan, before its pushes.
        on_observation: called with the first observation and with that after every push.
    """
    episode = Episode(seed)
    generator = torch.Generator().manual_seed(planner_seed(seed))
    observation, _ = env.reset(seed=seed)
    if on_observation is not None:
        on_observation(observation)
    ended = False
    while not ended:
        began = time.perf_counter()
        state = observed_state(observation, pointnet)
        plan = planner.plan(state, [generator], episode.decisions[-1].plan if episode.decisions else None)
        decision = Decision(
            step=len(episode.pushes),
            centers=observation["centers"],
            mask=observation["mask"].astype(np.bool_),
            plan=plan,
            milliseconds=1e3 * (time.perf_counter() - began),
            photograph=env.render() if photograph else None,
            clouds=observation["clouds"] if photograph else None,
        )
        episode.decisions.append(decision)
        if on_decision is not None:
            on_decision(decision)
        actions = plan.actions[0].numpy()
        for number, action in enumerate(actions[:pushes_per_plan]):
            action = np.clip(action, -1.0, 1.0).astype(np.float32)
            observation, reward, terminated, truncated, info = env.step(action)
            if on_observation is not None:
                on_observation(observation)
            last = number == len(actions) - 1
            episode.pushes.append(
                Push(
                    step=info["steps"],
                    action=action,
                    reward=float(reward),
                    centers=observation["centers"],
                    subgoal_distance=_subgoal_distance(decision, observation["centers"]) if last else float("nan"),
                    **{name: info[name] for name in ("success", "violation", "fall", "unsafe", "ineffective")},
                )
            )
            ended = terminated or truncated
            if ended:
                episode.outcome = next((name for name in OUTCOMES[:3] if info[name]), "timeout")
                break
    if photograph:
        episode.photograph, episode.clouds = env.render(), observation["clouds"]
    return episode


def _subgoal_distance(decision: Decision, centers: NDArray[np.float32]) -> float:
    subgoals = decision.plan.subgoals.centers[0]
    if len(subgoals) == 0:
        return float("nan")
    objects = len(subgoals[0])
    distance = np.linalg.norm(subgoals[0].numpy() - centers[:objects], axis=-1)
    return float(distance[decision.mask[:objects]].mean())
