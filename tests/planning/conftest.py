"""Toy worlds with known answers. Positions are in metres; only the plane's two coordinates ever change."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace
from typing import Any, NamedTuple

import pytest
import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal

from cavin_pyro.models.state import State
from cavin_pyro.planning import searching
from cavin_pyro.planning.protocol import Reward, SegmentRollout
from cavin_pyro.planning.sampling import noise_each

REACH = 0.15  # metres per segment and axis, the most that an effect of `PointMass` moves an object of gain 1


class PointMass:
    """h moves objects by 0.15 m times tanh(c), g splits that into T pushes and adds `noise * z`, f obeys.

    Each move is multiplied by the object's gain, the first number of its features.
    """

    segment_length, action_dimension = 3, 4
    effect_dimension = motion_dimension = 16

    def __init__(self, noise: float = 0.02) -> None:
        self.noise = noise  # metres per push

    def effect_prior(self, state: State) -> Distribution:
        return standard_normal(state)

    def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
        return standard_normal(state)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return move(state, REACH * effect_code[..., :2].tanh())

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        share = REACH * effect_code[..., :2].tanh() / self.segment_length
        motions = share.unsqueeze(-2) + self.noise * motion_code[..., :6].unflatten(-1, (3, 2))
        return torch.cat([torch.zeros_like(motions), motions / 0.1], -1)

    def next_state(self, state: State, action: Tensor) -> State:
        return move(state, 0.1 * action[..., 2:])


class Single(PointMass):
    """One code for effects and pushes, which do what h says."""

    def actions(self, state: State, effect_code: Tensor) -> Tensor:  # type: ignore[override]
        return super().actions(state, effect_code, torch.zeros_like(effect_code))


class Flat:
    """Without effects: the T = 3 pushes are the motion code's first six numbers, times 0.05 m; f obeys."""

    segment_length, action_dimension = 3, 4
    motion_dimension = 16

    def motion_prior(self, state: State) -> Distribution:
        return standard_normal(state)

    def actions(self, state: State, *, motion_code: Tensor) -> Tensor:
        motions = 0.5 * motion_code[..., :6].unflatten(-1, (3, 2))
        return torch.cat([torch.zeros_like(motions), motions], -1).clamp(-1.0, 1.0)

    def next_state(self, state: State, action: Tensor) -> State:
        return move(state, 0.1 * action[..., 2:])


class Tabled:
    """One object on a line, codes from tables: h moves it by c, each of the T = 2 pushes by c / 2 + z."""

    segment_length, action_dimension = 2, 4
    effect_dimension = motion_dimension = 16

    def __init__(self, effects: Sequence[Sequence[float]], motions: Sequence[Sequence[float]]) -> None:
        self.effects = iter(effects)
        self.motions = iter(motions)

    def effect_prior(self, state: State) -> Distribution:
        return Listed(self.effects)

    def motion_prior(self, state: State, effect_code: Tensor) -> Distribution:
        return Listed(self.motions)

    def subgoal(self, state: State, effect_code: Tensor) -> State:
        return move(state, effect_code[..., :2])

    def actions(self, state: State, effect_code: Tensor, motion_code: Tensor) -> Tensor:
        push = effect_code[..., :2] / 2 + motion_code[..., :2]
        return torch.cat([torch.zeros_like(push), push], -1).unsqueeze(-2).repeat(1, 1, 2, 1)

    def next_state(self, state: State, action: Tensor) -> State:
        return move(state, action[..., 2:])


class Listed(Distribution):
    """Draws the table's next row, a first coordinate per plan; the other 15 are zero."""

    arg_constraints: dict = {}

    def __init__(self, rows: Iterator[Sequence[float]]) -> None:
        super().__init__(validate_args=False)
        self.rows = rows

    def sample(self, sample_shape: object = ()) -> Tensor:
        first = torch.tensor(next(self.rows))
        return torch.cat([first[:, None], torch.zeros(len(first), 15)], -1)


class Placed:
    """A search space whose noise, two numbers per segment, is x and y of the target in metres."""

    dimension = 2

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> SegmentRollout:
        if noise is None:
            noise = noise_each((plans.batch_shape[-1], 2), generators)
        centers = plans.centers.clone()
        centers[..., 0, :2] = noise
        states = plans._replace(centers=centers)
        return SegmentRollout(noise, None, states, centers.unsqueeze(-3))


class StepOutcome(NamedTuple):
    reward: Tensor
    success: Tensor
    failure: Tensor


class GoalDisc(Reward):
    """The target must reach a disc, and no real object may enter the half-plane y < `forbidden_below`."""

    about, maximum_return = "", torch.inf  # attributes, so that a test may say something else

    def __init__(
        self,
        goal: tuple[float, float],
        radius: float = 0.05,
        forbidden_below: float = -torch.inf,
        dense: bool = False,
        about: str = "",
    ) -> None:
        self.goal, self.radius, self.forbidden_below, self.dense = goal, radius, forbidden_below, dense
        self.maximum_return, self.about = torch.inf if dense else 99.0, about

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> StepOutcome:
        success = self.distance(centers) <= self.radius
        failure = ((centers[..., 1] < self.forbidden_below) & mask).any(-1)
        reward = 100.0 * success - 100.0 * failure - 1.0
        if self.dense:
            reward = reward + self.distance(previous) - self.distance(centers)
        return StepOutcome(reward, success, failure)

    def distance(self, centers: Tensor) -> Tensor:
        return (centers[..., 0, :2] - torch.tensor(self.goal, dtype=centers.dtype)).norm(dim=-1)


class Hill(Reward):
    """Every step earns minus the squared distance of the target to a place; nothing ends."""

    def __init__(self, top: tuple[float, float]) -> None:
        self.top = top

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> StepOutcome:
        distance = (centers[..., 0, :2] - torch.tensor(self.top, dtype=centers.dtype)).square().sum(-1)
        never = torch.zeros_like(distance, dtype=torch.bool)
        return StepOutcome(-distance, never, never)


class Line(Reward):
    """The target, on a line, succeeds from x = 1 on and fails up to x = -0.5."""

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> StepOutcome:
        x = centers[..., 0, 0]
        success, failure = x >= 1.0, x <= -0.5
        return StepOutcome(100.0 * success - 100.0 * failure - 1.0, success, failure)


def standard_normal(state: State) -> Distribution:
    return Independent(Normal(state.centers.new_zeros(*state.batch_shape, 16), 1.0), 1)


def move(state: State, displacement: Tensor) -> State:
    gain = state.features[..., :1]
    planar = gain * displacement.unsqueeze(-2)
    shift = torch.cat([planar, torch.zeros_like(planar[..., :1])], -1)
    return state._replace(centers=state.centers + shift)


def scenes(positions: Sequence[Sequence[tuple[float, float]]], gains: Sequence[float] = (1.0,)) -> State:
    """A batch of scenes from the objects' x and y: `[B, M]` pairs, and a gain per object."""
    planar = torch.tensor(positions)
    centers = torch.cat([planar, torch.full_like(planar[..., :1], 0.03)], -1)
    features = torch.tensor(gains)[:, None].expand(*planar.shape[:-1], 1).clone()
    return State(centers, features, torch.ones(planar.shape[:-1], dtype=torch.bool))


def line(centers: Tensor) -> list[float]:
    """The x of the target in all states `[..., M, 3]`, in order."""
    return centers[..., 0, 0].flatten().tolist()


def tensors(record: Any) -> list[Tensor]:
    """All tensors of a plan or another record of records, in order."""
    if isinstance(record, tuple):
        return [tensor for part in record for tensor in tensors(part)]
    return [] if record is None else [record]


def same(one: Tensor, other: Tensor) -> bool:
    """Whether two tensors have the same numbers; what a planner does not know is NaN in both."""
    known = ~one.isnan() if one.is_floating_point() else torch.ones_like(one, dtype=torch.bool)
    return one.shape == other.shape and torch.equal(one[known], other[known]) and bool(other[~known].isnan().all())


def generators(*seeds: int) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in seeds]


@pytest.fixture(autouse=True)
def environments_in_one_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plan all environments of a test in one chunk, so that what is computed for several at once is tested."""
    monkeypatch.setattr(searching, "ENVIRONMENTS_ON_PROCESSOR", 1000)


@pytest.fixture
def toy() -> SimpleNamespace:
    worlds: list[Callable] = [PointMass, Single, Flat, Tabled, Placed, GoalDisc, Hill, Line, StepOutcome]
    names = [*worlds, move, scenes, generators]
    return SimpleNamespace(**{name.__name__: name for name in names}, REACH=REACH)
