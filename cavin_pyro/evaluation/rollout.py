"""The closed loop: observe, plan, push T times, repeat (paper, Algorithm 1, lines 3, 4, 11 and 12)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from cavin_pyro.config.device import choose_device
from cavin_pyro.config.errors import UserError, refused, user_input
from cavin_pyro.config.options import MAXIMUM_SEED
from cavin_pyro.envs.randomness import planner_seed
from cavin_pyro.envs.world import ACTION_DECIMALS, NoRoomError, World, advance, begin, check_goal, observed_state
from cavin_pyro.models.checks import check_number, told, typed
from cavin_pyro.planning import Plan, Planner
from cavin_pyro.planning.checks import NoFiniteCandidateError, OptimizerError, UnsuitedError
from cavin_pyro.planning.records import apply
from cavin_pyro.planning.rollout import project

OUTCOMES = ("success", "violation", "fall", "timeout")


@dataclass(frozen=True)
class PlanRecord:
    """One plan, with the observation behind it. `rollout` executes T of its pushes, or fewer.

    `step`: pushes made before. `centers`: [M, 3] metres and `mask`: [M], as observed. `plan`: for one environment.
    `milliseconds`: from the observation to the plan. `photograph`: [height, width, 3], if asked for.
    """

    step: int
    centers: NDArray[np.float32]
    mask: NDArray[np.bool_]
    plan: Plan
    milliseconds: float
    photograph: Any = None

    @property
    def share_reaching_goal(self) -> float | None:
        """Share of the plan's candidates that reach the goal by the model; None if its planner predicts nothing."""
        share = self.plan.share_reaching_goal
        return None if share is None else float(share[0])

    @property
    def prospect(self) -> str:
        """The share of candidates that reach the goal, to append to a line; "" if the planner predicts nothing."""
        share = self.share_reaching_goal
        if share is None:
            return ""
        return f", {100 * share:.1f} % of candidates reach the goal" if share else ", no candidate reaches the goal"


@dataclass(frozen=True)
class Transition:
    """One executed push.

    Attributes:
        step: number of the push, from 1. action: [4] normalised, as executed.
        reward, success, ..., ineffective: of the environment.
        centers: [M, 3] metres, as observed after the push.
        subgoal_distance: metres, the mean over objects from their centres to the plan's first subgoal; NaN before a
            segment's last push and for planners without subgoals.
        strict_reward: by `criterion=strict`. strict_end: one of `OUTCOMES` if an episode ends here by it, else "".
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
    strict_reward: float = 0.0
    strict_end: str = ""


@dataclass
class Episode:
    """One episode. outcome: one of `OUTCOMES`. photograph: as in `PlanRecord`, after the last push."""

    seed: int
    outcome: str = "timeout"
    plan_records: list[PlanRecord] = field(default_factory=list)
    transitions: list[Transition] = field(default_factory=list)
    photograph: Any = None

    @property
    def total_reward(self) -> float:
        """The episode's return."""
        return sum(transition.reward for transition in self.transitions)

    def strict(self) -> tuple[str, int, float]:
        """Outcome, pushes and return by `criterion=strict`, if the episode was run by rules that end it no sooner."""
        total = 0.0
        for transition in self.transitions:
            total += transition.strict_reward
            if transition.strict_end:
                return transition.strict_end, transition.step, total
        return "timeout", len(self.transitions), total

    def reached(self, record: PlanRecord) -> NDArray[np.float32]:
        """Centres observed after each push of a plan: [n, M, 3] metres, n <= T."""
        later = [other.step for other in self.plan_records if other.step > record.step]
        transitions = self.transitions[record.step : min(later, default=len(self.transitions))]
        centers = np.array([transition.centers for transition in transitions], dtype=np.float32)
        return centers.reshape(-1, *record.centers.shape)


class EpisodeCallback:
    """Callbacks of `rollout` during an episode. A subclass overrides the methods that it needs."""

    def on_observation(self, observation: Any) -> None:
        """Called with the first observation and with the one after every push."""

    def on_plan(self, record: PlanRecord) -> None:
        """Called after every plan, before its pushes."""

    def on_frame(self) -> None:
        """Called a few times during every push."""

    def on_transition(self, transition: Transition) -> None:
        """Called after every push, after its observation."""

    def on_end(self, episode: Episode) -> None:
        """Called once, after the last push."""


@typed(UserError)
def rollout(
    env: World,
    planner: Any,
    *,
    seed: int,
    pushes_per_plan: int | None = 1,
    push_decimals: int | None = ACTION_DECIMALS,
    photograph: bool = False,
    callbacks: Sequence[EpisodeCallback] = (),
    device: str | torch.device = "cpu",
    start: Any = None,
) -> Episode:
    """Run one episode in a world.

    trained = cavin_pyro.load("contact")
    env = cavin_pyro.make_env(task="crossing", geometry=trained.geometry)
    episode = cavin_pyro.rollout(env, cavin_pyro.make_planner(trained.model), seed=1)
    print(episode.outcome, len(episode.transitions))

    Args:
        env: as `make_env` makes it. planner: as `make_planner`, or with its method `plan`.
        seed: of the scene; the planner's randomness is derived from it and independent of the scene's.
        pushes_per_plan: pushes to execute before the next plan; None executes all T (paper, Algorithm 1, line 11). A
            planner with the addition `first_push` is for 1.
        push_decimals: to which planned actions are rounded (`cavin_pyro.planning.rollout.project`), so that an episode
            does not depend on how a machine rounds; None executes them as planned.
        photograph: keep a picture with every plan.
        callbacks: called in this order; without any, no frame is computed.
        start: an observation of the world, to go on from there; by default it is reset.
        device: of the planner's model. Records of plans are on the CPU, as is the planner's randomness.

    Raises:
        UserError: no episode can begin from the seed, the planner found no plan with finite numbers, or an
            optimizer, a world or a planner of the user's own raises an error.
        RuntimeError: the robot stands in the camera's view.
    """
    if not hasattr(planner, "plan") or isinstance(planner, type):
        raise UserError(f"planner must be a Planner, as of make_planner, not {told(planner)}")
    device = choose_device(device) if isinstance(device, str) else device
    with user_input():
        check_number("push_decimals", 1 if push_decimals is None else push_decimals, 1, 6, whole=True)
        check_number("seed", seed, 0, MAXIMUM_SEED, whole=True)
    if getattr(getattr(planner, "model", None), "space", env.space) != env.space:
        raise UserError(f"the planner's model is of a world with other dimensions or units than {type(env).__name__}")
    if photograph and env.render_mode is None:
        raise UserError(f"photograph=True needs a {type(env).__name__} with pictures: build it with render=True")
    if start is not None:
        with user_input(where="start is no observation as of env.reset or env.step"):
            env.state(start)
    episode = Episode(seed := int(seed))  # Gymnasium takes no other kind of whole number
    generator = torch.Generator().manual_seed(planner_seed(seed))

    def on_frame() -> None:
        for callback in callbacks:
            callback.on_frame()

    env.on_frame = on_frame if callbacks else None
    with refusals(seed, env):
        observation = begin(env, seed) if start is None else start
        goal = env.goal(device)
    for callback in callbacks:
        callback.on_observation(observation)
    ended = False
    while not ended:
        began = time.perf_counter()
        with refusals(seed, env):
            seen = observed_state(env, observation).map(lambda field: field.to(device))
            if not episode.plan_records:
                check_goal(env, goal, seen)
            state = seen.map(lambda field: field.unsqueeze(0))
            shown = env.observed(observation)
        shown = shown and apply(shown, lambda field: field.to(device))
        with refusals(seed, env), refusals(seed, planner):  # the user's may be a task, which the planner asks
            left = env.maximum_steps - len(episode.transitions)
            plan = planner.plan(state, reward=goal, generators=[generator], observed=shown, steps_left=left)
            if not isinstance(plan, Plan):
                raise UserError(f"{type(planner).__name__}.plan must return a Plan, not {type(plan).__name__}")
            shape = [*plan.actions.shape] if isinstance(plan.actions, torch.Tensor) else told(plan.actions)
            if len(shape) != 3 or shape[::2] != [1, env.space.actions] or not plan.actions.isfinite().all():
                wanted = f"actions [1, T, {env.space.actions}], all finite"
                raise UserError(f"{type(planner).__name__}.plan must return {wanted}, not {shape}")
        plan = apply(plan, lambda field: field.cpu())
        centers, mask = env.positions(observation)
        record = PlanRecord(
            step=len(episode.transitions),
            centers=centers,
            mask=mask,
            plan=plan,
            milliseconds=1e3 * (time.perf_counter() - began),
            photograph=_picture(env, seed) if photograph else None,
        )
        episode.plan_records.append(record)
        for callback in callbacks:
            callback.on_plan(record)
        actions = project(plan.actions[0], push_decimals).numpy()
        if not 1 <= (len(actions) if pushes_per_plan is None else pushes_per_plan) <= len(actions):
            raise UserError(f"pushes_per_plan must be between 1 and {len(actions)}, not {pushes_per_plan}")
        for number, action in enumerate(actions[:pushes_per_plan]):
            with refusals(seed, env):
                observation, earned, terminated, truncated, info = advance(env, action)
                centers, _ = env.positions(observation)
            last = number == len(actions) - 1
            ends = info if "violation" in info else {**info, "violation": terminated and not info["success"]}
            strict = {**ends, "reward": earned, **info.get("strict", {})}
            transition = Transition(
                step=len(episode.transitions) + 1,
                action=action,
                reward=float(earned),
                centers=centers,
                subgoal_distance=_subgoal_distance(record, centers) if last else float("nan"),
                strict_reward=float(strict["reward"]),
                strict_end=_end(strict),
                **{name: ends.get(name, False) for name in ("success", "violation", "fall", "unsafe", "ineffective")},
            )
            episode.transitions.append(transition)
            for callback in callbacks:
                callback.on_observation(observation)
                callback.on_transition(transition)
            ended = terminated or truncated
            if ended:
                episode.outcome = _end(ends) or "timeout"
                break
    if photograph:
        episode.photograph = _picture(env, seed)
    for callback in callbacks:
        callback.on_end(episode)
    return episode


@contextmanager
def refusals(seed: int, part: World | Planner) -> Iterator[None]:
    """What is wrong with a scene or a search, and whatever comes of a part of the user's own, as a `UserError`."""
    try:
        yield
    except NoRoomError as error:
        raise UserError(f"seed={seed}: {error}") from error
    except (OptimizerError, NoFiniteCandidateError, UnsuitedError) as error:
        raise UserError(str(error)) from error
    except (Exception, SystemExit) as error:
        known = ("cavin_pyro", "torch", "pyro", "builtins")
        ours = all(type(one).__module__.partition(".")[0] in known for one in _parts(part))
        if ours or isinstance(error, UserError):
            raise
        raise refused(error, f"{type(part).__name__}, seed={seed}", ("env", "planner", "task")) from error


def _parts(part: Any) -> Iterator[Any]:
    """A world or a planner, and the parts of it that may be of the user's own."""
    yield part
    for name in ("optimizer", "motion_optimizer", "task", "scene", "sensor", "segmenter", "robot"):
        yield from _parts(getattr(part, name)) if hasattr(part, name) else ()
    yield from getattr(part, "additions", ())
    yield from part.model.modules() if isinstance(getattr(part, "model", None), torch.nn.Module) else ()


def _picture(env: World, seed: int) -> Any:
    with refusals(seed, env):
        return env.render()


def _end(flags: Mapping[str, Any]) -> str:
    """Which of the outcomes a step came to, "" if the episode goes on."""
    return next((name for name in OUTCOMES[:3] if flags.get(name)), "")


def _subgoal_distance(record: PlanRecord, centers: NDArray[np.float32]) -> float:
    subgoals = record.plan.subgoals.centers[0]
    if len(subgoals) == 0:
        return float("nan")
    objects = len(subgoals[0])
    distance = np.linalg.norm(subgoals[0].numpy() - centers[:objects], axis=-1)
    return float(distance[record.mask[:objects]].mean())
