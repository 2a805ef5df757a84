"""What a world must say: each slip is refused in one line; and a world of one's own in the place of the tabletop."""

from __future__ import annotations

import math
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from torch import Tensor

from cavin_pyro.config.composition import compose
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.world import world_of
from cavin_pyro.envs.world import Goal, World, check_world
from cavin_pyro.evaluation.rollout import rollout
from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State
from cavin_pyro.planning import RandomPlanner

SPACE = Space(origin=(0.0,), length=1.0, step_range=0.5, subgoal_range=1.0, action_sizes=(1,), unit_features=2)
REAL, SAID = torch.ones(1, dtype=torch.bool), {"success": False}
TARGET = f"env._target_={__name__}.Line"


class Far(Goal):
    """To be beyond 1; below -1 is a failure."""

    def success(self, state: State) -> Tensor:
        return state.centers[..., 0, 0] > 1

    def failure(self, state: State) -> Tensor:
        return state.centers[..., 0, 0] < -1

    def distance(self, state: State) -> Tensor:
        return 1 - state.centers[..., 0, 0]


class Slips(Far):
    """Forgets to choose the object."""

    def success(self, state: State) -> Tensor:
        return state.centers[..., 0] > 1


class Counts(Far):
    def success(self, state: State) -> Tensor:
        return state.centers[..., 0, 0]


class Line(World):
    """A point on a line, whose feature is a direction and a number that is free."""

    space = SPACE
    objects, features, maximum_steps = 1, 3, 5
    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))

    def __init__(self, size: float = 1.0) -> None:
        self.size = size

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[float, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = 0.0
        return self.place, {}

    def step(self, action: np.ndarray) -> tuple[float, float, bool, bool, dict[str, Any]]:
        self.place += 0.5 * float(action[0])
        return self.place, 0.0, False, False, {"success": False}

    def state(self, observation: Any) -> State:
        return State(torch.tensor([[observation]]), torch.tensor([[0.6, 0.8, 7.0]]), REAL)

    def goal(self, device: Any = "cpu") -> Any:
        return Far(SPACE, weight=2.0)


def of(**members: Any) -> type[Line]:
    """The world with other members."""
    return type("Line", (Line,), members)


def states(*places: float) -> Tensor:
    """Positions and features: [..., M, P + F] of paths with these places."""
    return torch.tensor([[[place, 0.6, 0.8, 7.0]] for place in places])


@pytest.mark.parametrize(
    ("members", "said"),
    [
        ({"action_space": gymnasium.spaces.Box(-1.0, 1.0, (2,))}, "has 1 numbers in an action, and its action_space"),
        ({"action_space": gymnasium.spaces.Discrete(3)}, "has 1 numbers in an action, and its action_space"),
        ({"action_space": gymnasium.spaces.Box(-2.0, 2.0, (1,))}, "must be a box from -1 to 1"),
        ({"features": 2}, r"must have centers, features and mask \(bool\) of .*, not \[\[1, 1\], \[1, 3\], \[1\]\]"),
        ({"objects": 2}, r"must have centers, features and mask"),
        ({"space": {"origin": 0}}, "space must be of type Space, not"),
        ({"reset": lambda world, **_: (math.nan, {})}, r"centers must be finite float32 numbers, not .*nan"),
        ({"step": lambda world, _: (math.inf, 0.0, False, False, SAID)}, "centers must be finite float32 numbers"),
        ({"step": lambda world, _: (0.0, 0.0, False, False, {})}, "info of a step must have success, and has nothing"),
        ({"step": lambda world, _: (0.0, 0.0, False, False, {"success": math.nan})}, "success as bool, not .* and nan"),
        ({"maximum_steps": 0}, "maximum_steps must be a whole number of at least 1, not 0"),
        ({"state": lambda world, place: State(torch.zeros(1, 1), torch.eye(3)[:1], ~REAL)}, "its mask has none"),
        ({"state": lambda world, place: State(torch.zeros(1, 1).double(), torch.zeros(1, 3), REAL)}, "not torch.float"),
        ({"state": lambda world, place: State(torch.zeros(1, 1), torch.ones(1, 3), REAL)}, "first 2 of a feature must"),
        ({"reset": lambda world, **_: 0.0}, "reset must give an observation and info, not 0.0"),
        ({"step": lambda world, _: 0.0}, "a step must give an observation, .* and info, not 0.0"),
        ({"step": lambda world, _: (0.0, math.nan, False, False, SAID)}, "must give a finite reward, .*, not nan"),
        ({"state": lambda world, place: (0.0, 0.0, REAL)}, r"state must be of type State, not \(0.0"),
        ({"goal": lambda world, *_: None}, r"its goal does not fit states \[5\]: 'NoneType' object is not callable"),
        ({"goal": lambda world, *_: Counts(SPACE)}, r"success must give bool \[5\], not"),
        ({"goal": lambda world, *_: Slips(SPACE)}, r"its goal must give success as bool \[5\], not bool \[5, 1\]$"),
    ],
)
def test_each_slip_of_a_world_is_refused_in_one_line(members: dict[str, Any], said: str) -> None:
    check_world(Line())
    with pytest.raises(ValueError, match=f"^Line: .*{said}") as raised:
        check_world(of(**members)())
    assert "\n" not in str(raised.value)
    if {"reset", "step", "goal"} & members.keys():  # an episode meets it, too
        with pytest.raises(UserError, match="Line|of its state") as raised:
            rollout(of(**members)(), RandomPlanner(action_dimension=1), seed=0)
        assert "Error" not in str(raised.value) and "\n" not in str(raised.value)


def test_a_state_that_changes_its_shape_in_an_episode_is_refused() -> None:
    twice = State(torch.zeros(2, 1), torch.zeros(2, 3), REAL.repeat(2))
    changing = of(state=lambda world, place: twice if place else Line().state(place))
    with pytest.raises(UserError, match="Line: a state must have centers"):
        rollout(changing(), RandomPlanner(action_dimension=1), seed=0)


def test_a_step_earns_its_end_its_time_and_its_progress() -> None:
    outcome = Far(SPACE, weight=2.0).along(states(0.0, 0.5, 0.25, 1.5, -2.0), REAL)
    assert outcome.success.tolist() == [False, False, True, False]
    assert outcome.failure.tolist() == [False, False, False, True]
    assert outcome.reward.tolist() == [0.0, -1.5, 101.5, -108.0]


def test_without_weight_a_reward_is_sparse_and_bounded() -> None:
    sparse = Far(SPACE)
    assert sparse.along(states(0.0, 0.5, 1.5), REAL).reward.tolist() == [-1.0, 99.0]
    assert (sparse.maximum_return, Far(SPACE, weight=1.0).maximum_return) == (99.0, math.inf)


def test_without_a_policy_of_its_own_a_world_collects_by_random_bursts() -> None:
    policies = [Line().policy(np.random.default_rng(seed)) for seed in (0, 0, 1)]
    one, same, other = (np.array([policy.act(None) for _ in range(400)])[:, 0] for policy in policies)
    assert (one == same).all() and (one != other).any()
    assert abs(one).max() == 1.0 and 50 < (np.diff(one) != 0).sum() < 150  # held for about 4 steps


def test_commands_take_a_world_of_ones_own_with_its_options() -> None:
    config = compose("plan", TARGET, "env.size=3")
    world = world_of(config)
    assert isinstance(world, Line) and world.size == 3
    assert config.planner.optimizer._target_.endswith("CEM") and config.pushes_per_plan is None  # planner=search
    chosen = compose("plan", TARGET, "planner=random")
    assert chosen.planner.model_free


def test_the_tabletop_is_the_world_where_none_is_chosen() -> None:
    assert world_of(compose("plan")) is None and world_of(compose("plan", "env=tabletop")) is None


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["env=nowhere"], "^unknown env 'nowhere': choose from .*pusht.*, or env._target_=CLASS$"),
        ([TARGET, "task=crossing"], "^task is an option of env=tabletop: leave it out"),
        ([TARGET, "env.width=3"], "Line.* got an unexpected keyword argument 'width'"),
        (["env._target_=fractions.Fraction"], "^fractions.Fraction is no World: derive it from"),
        (["env._target_=nowhere.World"], "nowhere"),
        (["env._target_="], "^unknown env ''"),
        (["env=pusht", "env.margin=-1"], "^margin must be a number above 0 and at most 1, not -1"),
    ],
)
def test_what_no_world_takes_is_refused_in_one_line(options: list[str], said: str) -> None:
    with pytest.raises(UserError, match=said) as raised:
        world_of(compose("plan", *options))
    assert "\n" not in str(raised.value)
