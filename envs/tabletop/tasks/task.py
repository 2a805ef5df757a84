"""Base class of tasks: their tiles, success, violations, and the terms of their reward; and the steps they judge.

A task is one class in one file of this folder; `layouts/` has its layouts. The same functions evaluate the steps
of the environment and the predicted steps of planners. Tensors may have any leading dimensions `[...]`.

Source: paper, section 4.1 and appendix "Task Details".
"""

from __future__ import annotations

import copy
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import MISSING, dataclass, fields
from typing import ClassVar, Literal, NamedTuple, TypeVar, get_type_hints

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from cavin_pyro.envs.tabletop.markings import Place, TileGroup
from cavin_pyro.envs.tabletop.observation import Observation
from cavin_pyro.envs.tabletop.tasks.generated import GeneratedLayouts
from cavin_pyro.envs.tabletop.tasks.tiles import TileSet, box_distance, parse_tiles
from cavin_pyro.envs.tabletop.workspace import REACH_HIGH, REACH_LOW, TILE_ORIGIN, TILE_SIDE, Tile, tile_center

STILL = 0.005  # metres; what moves by less is taken to stay where it is

Depth = Callable[[Tensor], Tensor]
"""Metres from points [..., 2] to the border of a forbidden place, positive within it: [...]."""


class Step(NamedTuple):
    """Planar centres of objects in T + 1 successive states, with a push from each to the next; object 0 is the target.

    A task evaluates all T steps at once: [..., T]. The environment evaluates T = 1 step at a time, planners whole
    segments, so that no state is evaluated twice.

    `states`: [..., T + 1, M, 2] metres. `mask`: [..., 1, M] bool, True for real objects. `margin`: safety margin in
    metres, for planners; else 0.
    """

    states: Tensor
    mask: Tensor
    margin: float

    @property
    def before(self) -> Tensor:
        """Positions before the push: [..., T, M, 2] metres."""
        return self.states[..., :-1, :, :]

    @property
    def after(self) -> Tensor:
        """Positions after the push: [..., T, M, 2] metres."""
        return self.states[..., 1:, :, :]

    @property
    def target(self) -> Tensor:
        """Position of the target after the push: [..., T, 2] metres."""
        return self.after[..., 0, :]

    def target_enters(self, depth: Depth) -> Tensor:
        """Whether the target is in a forbidden place: [..., T] bool.

        Within the margin around that place, an object may stay where it is or move away, but come no closer.
        """
        return self._enters(depth, self.states[..., :1, :]).squeeze(-1)

    def any_enters(self, depth: Depth) -> Tensor:
        """Whether any real object is in a forbidden place, with the margin as in `target_enters`: [..., T] bool."""
        return (self._enters(depth, self.states) & self.mask).any(dim=-1)

    def any_leaves_reach(self, arrived: Callable[[Tensor], Tensor]) -> Tensor:
        """Whether a push moves any real object out of the tool's reach, the margin included, or farther: [..., T] bool.

        By more than `STILL`: predictions of an object that nothing touches differ by less. What lies there may stay.

        `arrived`: whether objects at points [..., M, 2] have arrived, where it does not matter: [..., M] bool.
        """
        depths = torch.where(arrived(self.states), -torch.inf, -box_distance(self.states, REACH_LOW, REACH_HIGH))
        before, after = depths[..., :-1, :], depths[..., 1:, :]
        return ((after > -self.margin) & (after > before + STILL) & self.mask).any(dim=-1)

    def all_within(self, depth: Depth) -> Tensor:
        """Whether every real object is more than the margin within a place, by its `depth`: [..., T] bool."""
        return ~(~(depth(self.after) > self.margin) & self.mask).any(dim=-1)

    def _enters(self, depth: Depth, states: Tensor) -> Tensor:
        """Of each object in `states: [..., T + 1, M, 2]`: [..., T, M] bool."""
        if self.margin == 0.0:
            return depth(states[..., 1:, :, :]) > 0.0
        depths = depth(states)  # once per state, although a state is after one push and before the next
        before, after = depths[..., :-1, :], depths[..., 1:, :]
        return (after > 0.0) | ((after > -self.margin) & (after > before))


GOAL_REWARD = 100.0
VIOLATION_REWARD = -100.0
TIME_REWARD = -1.0


Self = TypeVar("Self", bound="Task")


class Marking(NamedTuple):
    """How pictures show the tiles of a task's `field`: name in legends, colour, and opacity of the fill."""

    field: str
    name: str
    color: str
    opacity: float


GOAL_MARKING = Marking("goal", "goal", "#F2C200", 0.70)  # gold


@dataclass(frozen=True, kw_only=True)
class Task(ABC):
    """A task in one layout.

    A subclass is a frozen dataclass. Each of its fields of type `TileSet` is a list of tiles in layout files, and takes
    any tiles `(i, j)` in Python; a field without a default needs at least one tile. Other fields are options.

    Attributes:
        name: by default the name of the class in lower case.
        markings: how pictures show the layout; later ones lie on top of earlier ones.
        about: the objects that the goal is about: the `target` (object 0), or `all`. Pictures show their subgoals,
            guidance follows their way, and for `all` the planner may track the first push.
        maximum_return: upper bound on sparse returns; a task that adds positive terms sets `math.inf`.
        goal_is_shared: whether one place is as good for each object as for another; else guidance follows `potential`.
        movable: the field with the goal's tiles, which a person may move during an episode; "": none.
        target_start, obstacle_start: tiles on which objects start.

    Raises ValueError: a tile is malformed, listed twice or off the table, or tiles contradict one another.
    """

    name: ClassVar[str]
    markings: ClassVar[tuple[Marking, ...]] = ()
    about: ClassVar[Literal["target", "all"]] = "target"
    maximum_return: ClassVar[float] = GOAL_REWARD + TIME_REWARD
    goal_is_shared: ClassVar[bool] = True
    movable: ClassVar[str] = ""

    target_start: TileSet
    obstacle_start: TileSet

    def __init_subclass__(cls) -> None:
        super().__init_subclass__()
        if "name" not in vars(cls):
            cls.name = cls.__name__.lower()

    def __post_init__(self) -> None:
        kinds = get_type_hints(type(self))
        for name, required in self.layout_keys().items():
            if kinds[name] is not TileSet:
                continue
            tiles = parse_tiles(getattr(self, name), name)
            if required and not tiles:
                raise ValueError(f"{name} needs at least one tile")
            object.__setattr__(self, name, TileSet(tiles))
        self.check()

    def check(self) -> None:  # noqa: B027 (a task may have nothing to check)
        """Raise ValueError if tiles contradict one another; the message need not name the layout's file."""

    @abstractmethod
    def success(self, step: Step) -> Tensor:
        """Whether the goal is reached: [...] bool."""

    def violation(self, step: Step) -> Tensor:
        """Whether a rule is broken, which ends the episode: [...] bool; by default never.

        `TaskReward` checks falls off the table for every task.
        """
        return torch.zeros_like(step.mask[..., 0])

    def published_violation(self, step: Step) -> Tensor:
        """As `violation`, by the published implementation's rules for real episodes: [...] bool; by default the same.

        Planners are as strict as ever: this is `criterion=published` of an environment.
        """
        return self.violation(step)

    def dead_end(self, step: Step) -> Tensor:
        """Whether an object enters a place from which hardly any push moves it to its goal: [...] bool.

        By default never. The environment does not forbid it. For planners with a margin it is a violation.
        """
        return torch.zeros_like(step.mask[..., 0])

    @abstractmethod
    def potential(self, positions: Tensor, mask: Tensor) -> Tensor:
        """Minus the remaining distance in metres: [...]; its increase over a step is the dense reward's `progress`.

        `positions`: [..., M, 2] metres. `mask`: [..., M] bool, True for real objects.
        """

    def terms(self, step: Step, success: Tensor, failure: Tensor, *, dense: bool) -> dict[str, Tensor]:
        """The reward's terms by name, each [...]; the reward is their sum.

        `success`, `failure`: [...] bool, at most one of them true.
        """
        progress = torch.zeros_like(step.target[..., 0])
        if dense:
            progress = self.potential(step.states, step.mask).diff(dim=-1)
        return {
            "goal": GOAL_REWARD * success,
            "violation": torch.where(failure, VIOLATION_REWARD, 0.0),  # a product with false is -0.0
            "time": torch.full_like(progress, TIME_REWARD),
            "progress": progress,
        }

    def of_episode(self, observation: Observation, generator: np.random.Generator) -> Task:
        """The task of one episode: this one, or a copy with the goal of that episode.

        The environment calls it with every scene that may become an episode, and the planner's reward is that of the
        returned task.

        `observation`: the episode's first. `generator`: for the goal alone, so that scenes do not depend on the task.
        """
        return self

    def goals(self) -> NDArray[np.float64]:
        """The middle of the tiles of `movable`, (x, y) metres: [1, 2]; none if it names none."""
        tiles = getattr(self, self.movable) if self.movable else ()
        return np.mean([tile_center(tile) for tile in tiles], axis=0, keepdims=True) if tiles else np.zeros((0, 2))

    def moved(self: Self, goals: NDArray[np.float64], target: Place) -> Self:
        """This task with its goal moved during an episode, by whole tiles; `target`: where the target is.

        Raises ValueError: tiles would be off the table, or contradict others.
        """
        if not self.movable:
            raise ValueError(f"the goal of {self.name} cannot be moved")
        along, across = np.rint((goals - self.goals())[0] / TILE_SIDE).astype(int).tolist()
        tiles = [(i + along, j + across) for i, j in getattr(self, self.movable)]
        here = np.rint((np.array(target) - TILE_ORIGIN) / TILE_SIDE).astype(int).tolist()
        other = copy.copy(self)
        object.__setattr__(other, self.movable, TileSet(parse_tiles(tiles, self.movable)))
        if self.about == "target":
            object.__setattr__(other, "target_start", TileSet([(here[0], here[1])]))
            other.check()
        return other

    def object_places(self) -> tuple[Place, ...]:
        """Where on the table each object has to go, in the order of objects, for pictures; by default nowhere."""
        return ()

    @classmethod
    def random_layouts(cls) -> tuple[Task, ...]:
        """The tasks that `layout=random` samples; if empty, those of the layouts in files."""
        return ()

    @classmethod
    def generate(cls, wanted: GeneratedLayouts, generator: np.random.Generator) -> Task:
        """The task in a new layout as `wanted`, for `layout=generated`; by default there are none.

        Raises ValueError: there is no such layout.
        """
        raise ValueError(f"task {cls.name} has no generated layouts: give another layout, or another task")

    @classmethod
    def layout_keys(cls) -> dict[str, bool]:
        """The fields of a layout, the task's own first, and whether each is required."""
        starts = [field.name for field in fields(Task)]
        ordered = sorted(fields(cls), key=lambda field: field.name in starts)
        return {field.name: field.default is MISSING and field.default_factory is MISSING for field in ordered}

    def to(self: Self, device: torch.device) -> Self:
        """This task with its tiles and tensors on a device, for planners there: its functions then copy nothing."""
        parts = {name: value for name, value in vars(self).items() if isinstance(value, TileSet | Tensor)}
        moved = {name: value.to(device) for name, value in parts.items()}
        if all(moved[name] is value for name, value in parts.items()):
            return self
        other = copy.copy(self)
        for name, value in moved.items():
            object.__setattr__(other, name, value)
        return other

    def tile_groups(self) -> list[TileGroup]:
        """The layout for pictures."""
        groups = [TileGroup(one.name, one.color, one.opacity, getattr(self, one.field).tiles) for one in self.markings]
        return [group for group in groups if group.tiles]


def check_apart(one: Iterable[Tile], other: Iterable[Tile], problem: str) -> None:
    """Raise ValueError if two groups share a tile, which replaces `{tile}` in `problem`."""
    if shared := set(one) & set(other):
        raise ValueError(problem.format(tile=list(min(shared))))


def check_inside(inner: Iterable[Tile], outer: Iterable[Tile], problem: str) -> None:
    """Raise ValueError if a tile of `inner` is not in `outer`; it replaces `{tile}` in `problem`."""
    if outside := set(inner) - set(outer):
        raise ValueError(problem.format(tile=list(min(outside))))


def check_functions(task: Task, objects: int) -> None:
    """Call the functions of a task once, on a few plans with that number of objects.

    Raises ValueError: one returns another type or shape than `Task` documents.
    """
    plans, steps = 8, 6  # other than one another and than any number of objects: no wrong shape fits by chance
    states, mask = torch.zeros(plans, steps + 1, objects, 2), torch.ones(plans, 1, objects, dtype=torch.bool)
    step = Step(states, mask, 0.0)
    flags = ("success", "violation", "published_violation", "dead_end")
    values = {name: (getattr(task, name)(step), "bool", [plans, steps]) for name in flags}
    values["potential"] = task.potential(states, mask), "metres", [plans, steps + 1]
    for name, (value, kind, shape) in values.items():
        fits = isinstance(value, Tensor) and (value.dtype == torch.bool) == (kind == "bool")
        sizes = [*zip(value.shape[::-1], shape[::-1], strict=False)] if fits else []
        fits = fits and value.ndim <= len(shape) and all(size in (1, wanted) for size, wanted in sizes)
        if not fits or (kind == "metres" and (1, steps + 1) in sizes[:1]):
            given = f"{value.dtype} {list(value.shape)}" if isinstance(value, Tensor) else type(value).__name__
            raise ValueError(f"task {type(task).__name__}: {name} must return {kind} [...], here {shape}, not {given}")
