"""A world of two coordinates, three numbers in an action and free features: every model learns and plans there."""

from __future__ import annotations

from typing import Any

import pyro
import pytest
import torch
from pyro.infer import Trace_ELBO
from torch import Tensor
from torch.nn.functional import normalize

from cavin_pyro.models.space import Space
from cavin_pyro.models.state import State, Window
from cavin_pyro.planning import (
    CavinPlanner,
    CavinWithoutEffectsPlanner,
    CvaeMpcPlanner,
    MpcPlanner,
    RandomPlanner,
    Reward,
    SectarPlanner,
)
from tests.guides.programs import make
from tests.planning.conftest import StepOutcome, generators

SPACE = Space(
    origin=[0.5, 0.5],
    length=0.2,
    step_range=0.1,
    subgoal_range=0.3,
    action_sizes=[2, 1],
    action_names=["motion", "grip"],
    action_limits=[1.0, 2.0],
    action_scales=[0.1, 0.3],
    unit_features=2,
    frequencies=1,
)
PLANNERS: list[tuple[type, str, str]] = [
    (CavinPlanner, "cascaded", "cascaded"),
    (CavinWithoutEffectsPlanner, "cascaded", "joint"),
    (SectarPlanner, "single_latent", "single_latent of actions"),
    (CvaeMpcPlanner, "flat", "flat"),
    (MpcPlanner, "dynamics", "none"),
]


class Last(Reward):
    """The target's last free feature, or its first coordinate; nothing ends."""

    def __init__(self, reads_features: bool) -> None:
        self.features = reads_features

    @property
    def reads_features(self) -> bool:
        return self.features

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> StepOutcome:
        assert centers.shape[-1] == (7 if self.features else 2)
        never = torch.zeros(centers.shape[:-2], dtype=torch.bool)
        return StepOutcome(centers[..., 0, -1 if self.features else 0], never, never)


@pytest.mark.parametrize("objects, features", [(1, True), (2, False)])
@pytest.mark.parametrize("kind, model, guide", PLANNERS)
def test_a_model_learns_and_plans(kind: Any, model: str, guide: str, objects: int, features: bool) -> None:
    torch.manual_seed(0)
    values = torch.cat((normalize(torch.randn(4, 4, objects, 2), dim=-1), 9 * torch.randn(4, 4, objects, 3)), -1)
    states = State(torch.rand(4, 4, objects, 2), values, torch.ones(4, 4, objects, dtype=torch.bool))
    masks = torch.ones(4, 3, dtype=torch.bool), torch.ones(4, dtype=torch.bool)
    window = Window(states, 2 * torch.rand(4, 3, 3) - 1, *masks)
    with pyro.settings.context(module_local_params=True):
        programs = make(model, guide, space=SPACE, feature_dimension=5)
        loss = Trace_ELBO().differentiable_loss(*programs, window)
        loss.backward()
    for program in programs:
        unused = [name for name, one in program.named_parameters() if one.grad is None]
        assert not unused or (objects == 1 and all("relation" in name or "difference" in name for name in unused))
    assert loss.isfinite()
    planner = kind(programs[0].requires_grad_(False), samples=8, horizon=6)
    plan = planner.plan(states.step(0), reward=Last(features), generators=generators(0, 1, 2, 3))
    assert plan.actions.shape == (4, 3, 3) and plan.actions.abs().amax() <= 1
    assert plan.predicted_centers.shape[-2:] == (objects, 2)
    assert torch.equal(plan.expected_return, plan.candidate_returns.amax(-1))


def test_random_actions_have_its_size() -> None:
    state = State(torch.rand(2, 1, 2), torch.rand(2, 1, 5), torch.ones(2, 1, dtype=torch.bool))
    plan = RandomPlanner(action_dimension=SPACE.actions).plan(state, generators=generators(0, 1))
    assert plan.actions.shape == (2, 3, 3) and plan.predicted_centers.shape == (2, 0, 1, 2)
