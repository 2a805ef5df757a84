"""Push-T as `gym-pusht` simulates it: a disc pushes a T-shaped block in a plane, from states instead of pictures.

Source: Chi et al. 2023 (Diffusion Policy) and `gym-pusht`; the pose criterion is `eval_state` of
`stable-worldmodel`, which goal-conditioned world models are evaluated by. All lengths are pixels of a window of 512.
"""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.pusht.policy import (
    RADIUS,
    REACH,
    SIZE,
    SKIN,
    SPACING,
    WALLS,
    ObservationDict,
    PushTPolicy,
    in_window,
    outline_of,
    rotation,
)
from cavin_pyro.envs.randomness import named_stream
from cavin_pyro.envs.world import Goal, NoRoomError, World, finite_numbers, known_options
from cavin_pyro.models.checks import check_choice, check_number
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

REPEAT = 5  # steps of the simulator, 0.1 s each, in one step of the environment
POSE_DISTANCE, POSE_ANGLE = 20.0, math.pi / 9  # pixels of disc and block together, radians of the block
COVERAGE = 0.95  # of the goal's area
COVERAGE_DISTANCE, COVERAGE_ANGLE = 4.0, 0.05  # pixels, radians of the block, within which that is so
FIXED_GOAL = 256.0, 400.0, 256.0, 256.0, math.pi / 4  # gym-pusht's block; the disc counts for the pose criterion only
CRITERIA = ("pose", "coverage", "none")
_GOAL = 1  # last entry of a spawn key: the stream of random goals
EPISODE = 60  # steps of an episode from which a start and its goal are taken
PICTURE = 680.0  # pixels of the simulator's picture


class PoseGoal(Goal):
    """Disc and block near a pose [5]: both positions, which count jointly, and the block's angle; or the block alone.

    distance: pixels. angle: radians. disc: whether it counts.
    """

    def __init__(self, space: Space, goal: NDArray[Any], *, distance: float, angle: float, disc: bool, weight: float):
        super().__init__(space, weight=weight)
        self._goal, self._limits, self._disc = [float(number) for number in goal], (distance, angle), disc

    def success(self, state: State) -> Tensor:
        distance, turn = self._errors(state)
        return (distance < self._limits[0]) & (turn < self._limits[1])

    def distance(self, state: State) -> Tensor:
        """In units of the two limits: 2 at both."""
        distance, turn = self._errors(state)
        return distance / self._limits[0] + turn / self._limits[1]

    def _errors(self, state: State) -> tuple[Tensor, Tensor]:
        """Pixels and radians, `[...]` each."""
        x, y, block_x, block_y, angle = self._goal
        squared = (state.centers - state.centers.new_tensor([[block_x, block_y], [x, y]])).square().sum(-1)
        cosine, sine = state.features[..., 0, 0], state.features[..., 0, 1]
        across = sine * math.cos(angle) - cosine * math.sin(angle)
        turn = torch.atan2(across, cosine * math.cos(angle) + sine * math.sin(angle))
        return (squared.sum(-1) if self._disc else squared[..., 0]).sqrt(), turn.abs()


class PushT(World):
    """Push a T to a goal pose. One step here is five of the simulator's, with the same target of the disc.

    Observation: `agent` [2] pixels, `velocity` [2] of the agent in pixels per second, `block` [3] (x, y in pixels,
    angle in radians from -pi to pi; the origin is the middle of the T's top edge).
    Action: the displacement [2] in [-1, 1] of the disc's target from the disc, in units of 100 pixels; the target is
    kept in the window. The simulator is deterministic: equal seeds and actions give equal bits.

    The criterion is judged after each of the simulator's steps, as published; a success ends the step there.
    `info` of a reset: `goal` [5], `excluded`. `info` of a step: `steps` so far, `simulator_steps` of this one,
    `success`.

    Its state has two objects, the block and the disc; a feature is the cosine and the sine of the angle.

    Args:
        ahead: steps of the simulator from the start to the goal in an episode of `PushTPolicy`, from which a reset
            takes both; starts at their goal are excluded, and counted in `excluded`. 0: both are random.
        criterion: "pose" (20 pixels and 20 degrees, see `PoseGoal`), "coverage" (more than 95 % of the goal's area, as
            `gym-pusht` ends an episode; the disc may be anywhere), or "none".
        maximum_steps: after how many steps an episode is truncated; published, 18 for `ahead=75` and 10 for 25.
        weight: of progress in the planner's reward, in units of the criterion's two limits. margin: the part of these
            limits within which a plan has to end.

    Raises ImportError: gym-pusht is not installed. ValueError: an argument is not one of those above.
    """

    metadata = {"render_modes": ["rgb_array"], "render_fps": 2}
    space = Space(
        origin=(256.0, 256.0),
        length=100.0,
        step_range=150.0,
        subgoal_range=400.0,
        action_sizes=(2,),
        center_scale=2.0,
        feature_scale=0.03,
        action_scales=(0.05,),
        unit_features=2,
        turning=True,
        frequencies=4,
        mirror=(-1.0, 1.0),  # of the T too
        mirror_features=(1.0, -1.0),
    )
    features, objects, names = 2, 2, ["T", ""]

    def __init__(
        self,
        *,
        criterion: str = "pose",
        ahead: int = 75,
        maximum_steps: int = 18,
        weight: float = 1.0,
        margin: float = 0.7,
        render_mode: str | None = None,
    ) -> None:
        check_choice("criterion", criterion, CRITERIA)
        check_number("maximum_steps", maximum_steps, 1, whole=True)
        check_number("ahead", ahead, 0, EPISODE * REPEAT, whole=True)
        if ahead % REPEAT:
            raise ValueError(f"ahead must be a multiple of {REPEAT}, not {ahead}")
        check_number("weight", weight)
        check_number("margin", margin, high=1, positive=True)
        check_choice("render_mode", render_mode, (None, "rgb_array"))
        try:
            from gym_pusht.envs import pusht
        except ImportError as error:
            line = f"Push-T needs gym-pusht ({error}): pip install -c constraints.txt -e '.[pusht]'"
            raise ImportError(line) from error
        self.criterion, self.maximum_steps, self.render_mode = criterion, maximum_steps, render_mode
        self.ahead, self._weight, self._margin = ahead // REPEAT, weight, margin
        self._module, self._simulator = pusht, pusht.PushTEnv(obs_type="state")
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        low, high = -SIZE, 2 * SIZE  # the simulator's disc and block may be pressed into a wall
        self.observation_space = gymnasium.spaces.Dict(
            {
                "agent": gymnasium.spaces.Box(low, high, (2,), np.float64),
                "velocity": gymnasium.spaces.Box(-1e4, 1e4, (2,), np.float64),
                "block": gymnasium.spaces.Box(
                    np.array([low, low, -np.pi]), np.array([high, high, np.pi]), dtype=np.float64
                ),
            }
        )
        self.pose = np.array(FIXED_GOAL)
        self._steps = -1

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationDict, dict[str, Any]]:
        """Begin at a state; the disc and the block are apart and within the walls unless told otherwise.

        The state is set exactly, and the block rests: from a state that was recorded while the block was pushed, the
        same actions give nearly the same states, because the simulator keeps the block's speed for 0.01 s.

        Args:
            options: `state`, 5 numbers (agent, block) or 7 (agent, block, the agent's velocity), and `goal`, 5
                numbers; instead of a random state, and of a random goal ("pose") or gym-pusht's ("coverage").

        Raises ValueError: `state` or `goal` has another length, or a number is not finite.
        """
        super().reset(seed=seed)
        (generator,) = self.np_random.spawn(1)
        given, excluded = known_options(options, "state", "goal"), 0
        if self.criterion == "pose" and self.ahead and not {"state", "goal"} & set(given):
            state, self.pose, excluded = self._pair(generator)
        else:
            state = finite_numbers("state", given["state"], 5, 7) if "state" in given else self._sample(generator)
            if "goal" in given:
                self.pose = finite_numbers("goal", given["goal"], 5)
            else:
                fixed = self.criterion != "pose"
                self.pose = np.array(FIXED_GOAL) if fixed else self._sample(named_stream(generator, _GOAL))
        self._set(state)
        self._steps = 0
        return self._observe(), {"goal": self.pose.copy(), "excluded": excluded}

    def step(self, action: NDArray[np.float32]) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Hold one target for five steps of the simulator, or until the criterion is met.

        Raises ValueError: the action is not two finite numbers. RuntimeError: called before `reset`.
        """
        if self._steps < 0:
            raise RuntimeError("call reset() before step()")
        simulator, agent = self._simulator, self._simulator.agent
        displacement = REACH * np.clip(finite_numbers("action", action, 2), -1.0, 1.0)
        x, y = np.clip(np.array(agent.position) + displacement, 0.0, SIZE).tolist()
        for done in range(1, REPEAT + 1):  # noqa: B007 -- says when the step ended
            if self.on_frame is not None:
                self.on_frame()
            for _ in range(round(1.0 / (simulator.control_hz * simulator.dt))):  # as gym-pusht's step, 5 times faster
                (px, py), (vx, vy) = agent.position, agent.velocity
                ax = simulator.k_p * (x - px) + simulator.k_v * (0 - vx)
                ay = simulator.k_p * (y - py) + simulator.k_v * (0 - vy)
                agent.velocity = vx + ax * simulator.dt, vy + ay * simulator.dt
                simulator.space.step(simulator.dt)
            success = self._is_success()
            if success:
                break
        self._steps += 1
        info = {"steps": self._steps, "simulator_steps": done, "success": success}
        return self._observe(), float(success), success, not success and self._steps >= self.maximum_steps, info

    def state(self, observation: ObservationDict) -> State:
        """See `World`: the block, then the disc, whose angle is always 0."""
        x, y, angle = observation["block"]
        centers = torch.tensor([[x, y], observation["agent"].tolist()], dtype=torch.float32)
        features = torch.tensor([[math.cos(angle), math.sin(angle)], [1.0, 0.0]], dtype=torch.float32)
        return State(centers, features, torch.ones(2, dtype=torch.bool))

    def goal(self, device: str | torch.device = "cpu") -> PoseGoal:
        """See `World`. For coverage the block alone has to be near the goal's pose."""
        return self._goal(self.pose, margin=self._margin, weight=self._weight)

    def goals(self) -> NDArray[np.float64]:
        """See `World`: the block's pose."""
        return self.pose[None, 2:].copy()

    def move_goals(self, goals: NDArray[np.float64]) -> None:
        """See `World`: the disc's place at the goal moves with the block's, and stays in the window."""
        block = finite_numbers("the goal of the T", np.reshape(goals, -1), 3)
        corners = outline_of(np.array([0.0, 0.0, *block]))
        if not ((corners > 0) & (corners < SIZE)).all():
            raise ValueError("the goal of the T must lie within the walls")
        disc = block[:2] + rotation(float(block[2] - self.pose[4])) @ (self.pose[:2] - self.pose[2:4])
        self.pose = np.array([*disc.clip(WALLS[0] + RADIUS, WALLS[1] - RADIUS), *block])

    def policy(self, generator: np.random.Generator) -> PushTPolicy:
        return PushTPolicy(generator)

    def pixels(self, centers: NDArray[np.floating]) -> NDArray[np.float64]:
        return np.asarray(centers, dtype=np.float64) * (PICTURE / SIZE)

    @property
    def landmarks(self) -> dict[str, NDArray[np.floating]]:
        return {"goal": self.pose[2:4]}

    def arrows(self, actions: NDArray[np.floating], centers: NDArray[np.floating]) -> NDArray[np.floating]:
        """See `World`: from the disc to its target."""
        return np.stack([centers[:, 1], centers[:, 1] + REACH * actions], axis=1)

    def coverage(self) -> float:
        """The part of the goal's area that the block covers, from 0 to 1."""
        block = self._simulator.block
        goal = self._simulator.get_goal_pose_body(self.pose[2:])
        shapes = [self._module.pymunk_to_shapely(body, block.shapes) for body in (block, goal)]
        return float(shapes[0].intersection(shapes[1]).area / shapes[1].area)

    def render(self) -> NDArray[np.uint8] | None:
        """Return a colour image [680, 680, 3] in mode rgb_array."""
        if self.render_mode is None:
            return None
        self._simulator.goal_pose = self.pose[2:]
        return np.array(self._simulator.render())

    def close(self) -> None:
        self._simulator.close()

    def _is_success(self) -> bool:
        if self.criterion == "coverage":
            return self.coverage() > COVERAGE
        return self.criterion == "pose" and bool(self._goal(self.pose).success(self.state(self._observe())))

    def _goal(self, pose: NDArray[np.float64], *, margin: float = 1.0, weight: float = 0.0) -> PoseGoal:
        """To be within the criterion's limits, times `margin`, of a pose [5]."""
        block_alone = self.criterion == "coverage"
        distance, angle = (COVERAGE_DISTANCE, COVERAGE_ANGLE) if block_alone else (POSE_DISTANCE, POSE_ANGLE)
        limits = {"distance": margin * distance, "angle": margin * angle}
        return PoseGoal(self.space, pose, **limits, disc=not block_alone, weight=weight)

    def _set(self, state: NDArray[np.float64]) -> None:
        """Put disc and block (5 or 7 numbers) into a fresh space; whatever is set, it has the same past."""
        simulator = self._simulator
        if not ((state[:4] >= -SIZE) & (state[:4] <= 2 * SIZE)).all():
            raise ValueError(
                f"places must be from {-SIZE:g} to {2 * SIZE:g} pixels, as observed, not {state[:4].tolist()}"
            )
        simulator.reset(seed=0, options={"reset_to_state": [50.0, 50.0, 256.0, 256.0, 0.0]})
        agent, block = simulator.agent, simulator.block
        numbers = state.tolist()
        agent.position, agent.velocity = tuple(numbers[:2]), tuple(numbers[5:]) or (0.0, 0.0)
        block.angle = numbers[4]  # turns about the centre of mass, so before the position
        block.position = tuple(numbers[2:4])
        for body in (agent, block):
            simulator.space.reindex_shapes_for_body(body)

    def _observe(self) -> ObservationDict:
        agent, block = self._simulator.agent, self._simulator.block
        angle = math.remainder(block.angle, 2 * math.pi)
        return {
            "agent": np.array(agent.position),
            "velocity": np.array(agent.velocity),
            "block": np.array([*block.position, angle]),
        }

    def _pair(self, generator: np.random.Generator) -> tuple[NDArray[np.float64], NDArray[np.float64], int]:
        """A start [7] and a goal [5] that is `ahead` of it in an episode of the policy, and how many were excluded."""
        criterion, self.criterion = self.criterion, "none"
        try:
            for excluded in range(100):
                policy, states = PushTPolicy(generator), []
                self._set(self._sample(generator))
                self._steps, first = 0, int(generator.integers(EPISODE - self.ahead + 1))
                for _ in range(first + self.ahead + 1):
                    observed = self._observe()
                    states.append(np.concatenate([observed["agent"], observed["block"], observed["velocity"]]))
                    self.step(policy.act(observed).astype(np.float32))
                start, goal = states[first], states[-1][:5]
                inside = all(bool(((outline_of(one) > 0) & (outline_of(one) < SIZE)).all()) for one in (start, goal))
                begun = self.state({"agent": start[:2], "block": start[2:5]})
                if inside and not bool(self._goal(goal).success(begun)):
                    return start, goal, excluded
        finally:
            self.criterion = criterion
        raise NoRoomError("no start apart from its goal in 100 episodes: choose a larger ahead")

    def _sample(self, generator: np.random.Generator) -> NDArray[np.float64]:
        """A random state [5] of gym-pusht's ranges, in which nothing touches anything."""
        while True:
            pose = np.array([*generator.uniform(100.0, 400.0, size=2), generator.uniform(-np.pi, np.pi)])
            agent = generator.uniform(50.0, 450.0, size=2)
            outline = in_window(pose, SKIN[0])
            # The disc's centre is outside if the nearest point of the outline shows it its outer side.
            nearest = int(np.linalg.norm(outline - agent, axis=-1).argmin())
            height = float((agent - outline[nearest]) @ (rotation(float(pose[2])) @ SKIN[1][nearest]))
            apart = height > 0 and float(np.linalg.norm(outline[nearest] - agent)) > RADIUS + SPACING
            if (outline > WALLS[0]).all() and (outline < WALLS[1]).all() and apart:
                return np.concatenate([agent, pose])
