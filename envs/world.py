"""What a domain must say, so that models learn it and planners reach goals in it."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from contextlib import suppress
from numbers import Real
from typing import Any, ClassVar, NamedTuple, Protocol

import gymnasium
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.models.checks import check_kinds, check_number, told, typed
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State

ACTION_DECIMALS = 3  # of an executed action's numbers; of a push 0.1 mm of its motion, 0.25 and 0.55 mm of its start
GOAL_REWARD = 100.0
STEP_REWARD = -1.0

Geometry = Callable[[Tensor], Tensor]
"""What makes a feature of each object's point cloud: `[..., points, 3]` -> `[..., F]`."""


def finite_numbers(name: str, values: Any, *lengths: int) -> NDArray[np.float64]:
    """Values of one of these lengths, such as an action; a ValueError if they are others, or one is not finite."""
    with suppress(TypeError, ValueError):
        array = np.asarray(values, dtype=np.float64)
        if array.ndim == 1 and len(array) in lengths and np.isfinite(array).all():
            return array
    raise ValueError(f"{name} must be {' or '.join(map(str, lengths))} finite numbers, not {values}")


def known_options(options: Mapping[str, Any] | None, *names: str, of: str = "reset") -> Mapping[str, Any]:
    """The options of a reset or the like, `{}` for None; a ValueError if one has another name."""
    check_kinds({f"options of {of}": options}, {f"options of {of}": Mapping[str, Any] | None})
    if unknown := sorted(set(options or {}) - set(names), key=str):
        raise ValueError(f"unknown option {unknown[0]!r} of {of}: choose from {', '.join(names)}")
    return options or {}


class Policy(Protocol):
    """What chooses the actions of collected episodes."""

    def act(self, observation: Any) -> NDArray[Any]:
        """The next action `[A]` in [-1, 1]."""


class RandomBursts:
    """Random actions `[size]`, each held for some steps, 4 on average, and one in four numbers at the box's border."""

    def __init__(self, generator: np.random.Generator, size: int) -> None:
        self._generator, self._action = generator, generator.uniform(-1.0, 1.0, size)

    def act(self, observation: Any) -> NDArray[np.float64]:
        if self._generator.random() < 0.25:
            self._action = self._generator.uniform(-1.3, 1.3, self._action.shape).clip(-1.0, 1.0)
        return self._action


class NoRoomError(ValueError):
    """No episode can begin from a seed as the world's options ask."""


class World(gymnasium.Env[Any, NDArray[np.float32]], ABC):
    """An environment of Gymnasium that models can learn and planners can act in.

    Its actions are a box [-1, 1] of A numbers; repeats of an action are hidden in `step`. `info` of a step has
    `success`, and an episode that ends without it has failed. Besides `reset` and `step` a world says:

    space       dimensions, units and ranges of states and actions
    features    F, numbers of an object's feature. objects: M
    state       of an observation
    goal        of the current episode
    policy      that collects; by default random actions, each for a while
    pixels      where positions lie in the picture of `render`, for drawings; None: they are drawn on axes
    names, landmarks, arrows    what drawings call objects and places, and how they show actions

    A caller may set `render_mode`, and `on_frame`, which a world may call during a step, to film it. A world that
    `sees_clouds` needs a checkpoint's `geometry` for its states.
    """

    space: ClassVar[Space]
    features: int
    objects: int
    maximum_steps: int
    on_frame: Callable[[], None] | None = None
    step_names: ClassVar[tuple[str, str]] = ("step", "steps")
    sees_clouds = False
    geometry: Geometry | None = None

    @abstractmethod
    def state(self, observation: Any) -> State:
        """The state `[]` of one observation: centres `[M, P]`, features `[M, F]`, mask `[M]`, float32."""

    @abstractmethod
    def goal(self, device: str | torch.device = "cpu") -> Any:
        """The reward of the current episode, for plans on a device: a `Goal`."""

    @property
    def name(self) -> str:
        """What pictures and results call the current episode."""
        return type(self).__name__

    def check_starts(self, seed: int) -> None:
        """Begin an episode of each kind that there is; raises ValueError where none can begin."""

    def goals(self) -> NDArray[np.float64]:
        """The goals that can be moved by hand: (x, y), or (x, y, radians) of each; by default none."""
        return np.zeros((0, 2))

    def move_goals(self, goals: NDArray[np.float64]) -> None:
        """Move all `goals` within the episode; a ValueError says why one cannot lie there."""
        raise ValueError(f"the goal of {self.name} cannot be moved")

    def observed(self, observation: Any) -> Any:
        """What additions to planners read besides the state: a named tuple of tensors `[1, ...]`; by default None."""
        return None

    def positions(self, observation: Any) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """The centres `[M, P]` and the mask `[M]` of an observation, without features."""
        state = self.state(observation)
        return state.centers.numpy(), state.mask.numpy()

    def policy(self, generator: np.random.Generator) -> Policy:
        """What collects an episode, by default `RandomBursts`; `generator`: all of its randomness."""
        return RandomBursts(generator, self.space.actions)

    def render(self) -> Any:
        """A picture `[height, width, 3]`; by default this world has none, and no video."""
        return

    def pixels(self, centers: NDArray[np.floating]) -> NDArray[np.float64] | None:
        """Columns and rows `[..., 2]` of positions `[..., P]` in the picture of `render`."""
        return None

    @property
    def names(self) -> list[str]:
        """What drawings call the objects; "" for a tool, whose paths are not drawn."""
        return [f"object {number}" for number in range(self.objects)]

    @property
    def landmarks(self) -> dict[str, NDArray[np.floating]]:
        """Names that drawings write, such as that of the goal, and the position `[P]` of each."""
        return {}

    def arrows(self, actions: NDArray[np.floating], centers: NDArray[np.floating]) -> NDArray[np.floating] | None:
        """Starts and ends `[T, 2, P]` by which drawings show actions `[T, A]`, each done at `centers: [T, M, P]`."""
        return None


class Outcome(NamedTuple):
    """The outcome of steps, in any batch `[...]`."""

    reward: Tensor
    success: Tensor
    failure: Tensor


class Goal(ABC):
    """The goal of an episode, as planners see it, from the whole state.

    reward = 100 at success, -100 at failure, -1 each step, and `weight` times the decrease of `distance`

    `space`: of the world. `weight`: of progress; 0 is a sparse reward.
    """

    reads_features = True
    about = "all"

    @typed(ValueError)
    def __init__(self, space: Space, *, weight: float = 0.0) -> None:
        check_number("weight", weight)
        self.space, self.weight = space, weight

    @abstractmethod
    def success(self, state: State) -> Tensor:
        """Whether states `[...]` are at the goal: `[...]` bool."""

    def failure(self, state: State) -> Tensor:
        """Whether states `[...]` end the episode without success: `[...]` bool; by default never."""
        return torch.zeros_like(state.mask[..., 0])

    def distance(self, state: State) -> Tensor:
        """What is left to the goal from states `[...]`: `[...]`; by default nothing, for sparse rewards."""
        return torch.zeros_like(state.centers[..., 0, 0])

    @property
    def maximum_return(self) -> float:
        """Upper bound on any return; infinite where progress counts."""
        return math.inf if self.weight else GOAL_REWARD + STEP_REWARD

    def distance_to_goal(self) -> None:
        """None: guidance has no map of this world."""
        return

    def __call__(self, previous: Tensor, values: Tensor, mask: Tensor) -> Outcome:
        """The outcome of steps from `previous` to `values: [..., M, P + F]`, `mask: [..., M]`: `[...]`."""
        state = self._state(values, mask)
        success, failed = self.success(state), self.failure(state)
        for name, found in (("success", success), ("failure", failed)):
            if getattr(found, "dtype", None) != torch.bool:
                wanted = f"bool {list(mask.shape[:-1])}"
                raise ValueError(f"{type(self).__name__}: {name} must give {wanted}, not {told(found)}")
        failure = failed & ~success
        reward = STEP_REWARD + GOAL_REWARD * (success.float() - failure.float())
        if self.weight:
            reward = reward + self.weight * (self.distance(self._state(previous, mask)) - self.distance(state))
        return Outcome(reward, success, failure)

    def along(self, values: Tensor, mask: Tensor) -> Outcome:
        """The outcomes of the T steps of paths `values: [..., T + 1, M, P + F]`, `mask: [..., M]`: `[..., T]`."""
        previous, after = values[..., :-1, :, :], values[..., 1:, :, :]
        return self(previous, after, mask.unsqueeze(-2).expand(after.shape[:-1]))

    def _state(self, values: Tensor, mask: Tensor) -> State:
        size = self.space.positions
        return State(values[..., :size], values[..., size:], mask)


def check_world(world: World) -> None:
    """Begin an episode, make a step, and check what the world says of them.

    Raises ValueError: its actions, a state or its goal have another shape than the world declares, or other numbers.
    """
    name, space = type(world).__name__, world.space
    check_kinds({f"{name}: space": space}, {f"{name}: space": Space})
    box = world.action_space
    if not isinstance(box, gymnasium.spaces.Box) or box.shape != (space.actions,):
        raise ValueError(f"{name}: its space has {space.actions} numbers in an action, and its action_space is {box}")
    if not (np.all(box.low == -1) and np.all(box.high == 1)):
        raise ValueError(f"{name}: its action_space must be a box from -1 to 1, not {box}")
    state = observed_state(world, begin(world, 0))
    _check_state(world, state)
    _check_state(world, observed_state(world, advance(world, np.zeros(space.actions, np.float32))[0]))
    check_number(f"{name}: maximum_steps", world.maximum_steps, 1, whole=True)
    if len(world.names) != world.objects:
        raise ValueError(f"{name}: names must be one for each of its {world.objects} objects, not {world.names}")
    check_goal(world, world.goal(), state)


def begin(world: World, seed: int) -> Any:
    """The observation of a reset; raises ValueError where a world gives something else."""
    given = world.reset(seed=seed)
    if not (isinstance(given, tuple) and len(given) == 2):
        raise ValueError(f"{type(world).__name__}: reset must give an observation and info, not {told(given)}")
    return given[0]


def advance(world: World, action: NDArray[Any]) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
    """What a step gives; raises ValueError where it is not what `World` says."""
    name, given = type(world).__name__, world.step(action)
    if not (isinstance(given, tuple) and len(given) == 5 and isinstance(given[4], Mapping)):
        wanted = "an observation, reward, terminated, truncated and info"
        raise ValueError(f"{name}: a step must give {wanted}, not {told(given)}")
    _, earned, ended, truncated, info = given
    if "success" not in info:
        raise ValueError(f"{name}: info of a step must have success, and has {', '.join(info) or 'nothing'}")
    flags = {type(ended), type(truncated), type(info["success"])} <= {bool, np.bool_}
    if not (flags and isinstance(earned, Real | Tensor) and math.isfinite(earned)):
        said = f"{earned}, {ended}, {truncated} and {info['success']}"
        raise ValueError(
            f"{name}: a step must give a finite reward, and terminated, truncated and success as bool, not {said}"
        )
    return given


def observed_state(world: World, observation: Any) -> State:
    """The state of an observation; raises ValueError for something else, or another shape than the world declares."""
    state, name = world.state(observation), type(world).__name__
    check_kinds({f"{name}: state": state}, {f"{name}: state": State})
    M = state.objects if world.sees_clouds else world.objects  # of which a camera may see some later than others
    shapes = [(M, world.space.positions), (M, world.features), (M,)]
    if [tuple(field.shape) for field in state] != shapes or state.mask.dtype != torch.bool:
        found = [list(field.shape) for field in state]
        raise ValueError(f"{name}: a state must have centers, features and mask (bool) of {shapes}, not {found}")
    return state


def check_goal(world: World, goal: Any, state: State) -> None:
    """Raise ValueError unless the goal of a world gives outcomes of states, here of copies of `state: []`."""
    name, plans = type(world).__name__, 5
    one = state.map(lambda field: field.expand(plans, *field.shape))
    try:
        values = one.values(getattr(goal, "reads_features", False))
        outcome = goal(values, values, one.mask)
    except (RuntimeError, TypeError, AttributeError, ValueError) as error:
        raise ValueError(f"{name}: its goal does not fit states [{plans}]: {str(error).splitlines()[0]}") from error
    for field in ("success", "failure", "reward"):  # the reward is made of the others
        value = getattr(outcome, field, None)
        wanted, given = f"{'numbers' if field == 'reward' else 'bool'} [{plans}]", type(value).__name__
        if isinstance(value, Tensor):
            given = f"{'bool' if value.dtype == torch.bool else 'numbers'} {[*value.shape]}"
        if given != wanted:
            raise ValueError(f"{name}: for states [{plans}] its goal must give {field} as {wanted}, not {given}")


def _check_state(world: World, state: State) -> None:
    name, space = type(world).__name__, world.space
    if not state.mask.any():
        raise ValueError(f"{name}: a state must have an object, and its mask has none")
    for part, values in (("centers", state.centers), ("features", state.features)):
        if values.dtype != torch.float32 or not values.isfinite().all():
            raise ValueError(f"{name}: {part} must be finite float32 numbers, not {values.dtype} {values.tolist()}")
    if not torch.allclose(space.project(state.features), state.features, atol=1e-3):
        unit = "all numbers" if space.unit_features is None else f"the first {space.unit_features}"
        raise ValueError(
            f"{name}: {unit} of a feature must be a vector of length 1 (unit_features of the space), "
            f"not {state.features.tolist()}"
        )
