"""Pyro's own inference, on planning as a Pyro program, finds the evidence that our planner finds."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import pyro
import pytest
import torch
from pyro import poutine
from pyro.distributions import Bernoulli
from pyro.infer import Importance
from torch import Tensor

from models.cascaded import CascadedModel
from models.priors.conditional import ConditionalPrior
from models.priors.standard import StandardPrior
from models.state import State
from planning import returns
from planning.optimizers import SequentialMonteCarlo
from planning.protocol import Evidence

SEGMENTS, RUNS, SAMPLES, TRACES = 2, 100, 100, 1000
BOUND = 2.0  # no return is higher


def small_model() -> CascadedModel:
    torch.manual_seed(0)
    model = CascadedModel(
        effect_dimension=2,
        motion_dimension=2,
        feature_dimension=1,
        width=8,
        effect_prior=ConditionalPrior(dimension=2, feature_dimension=1),
        motion_prior=StandardPrior(dimension=2, feature_dimension=1, effect_dimension=2),
    )
    for name, parameter in model.named_parameters():
        if name.startswith("effect_prior") or name.startswith("prior"):
            torch.nn.init.normal_(parameter, std=0.3)
    return model.eval().requires_grad_(False)


class Near:
    """Every step earns 0.3 minus the distance of the target to a place, in units of 10 cm; nothing ends."""

    def __init__(self, toy: SimpleNamespace) -> None:
        self.outcome = toy.StepOutcome

    def __call__(self, previous: Tensor, centers: Tensor, mask: Tensor) -> Any:
        distance = (centers[..., 0, :2] - torch.tensor([0.6, 0.2])).norm(dim=-1)
        never = torch.zeros_like(distance, dtype=torch.bool)
        return self.outcome(0.3 - 10 * distance, never, never)


def program(model: CascadedModel, reward: Any, state: State, temperature: float) -> None:
    """The program of docs/reference/pyro.md."""
    progress = returns.start(state.centers)
    for k in range(SEGMENTS):
        c = pyro.sample(f"effect_code_{k}", model.effect_prior(state).to_event(1))
        subgoal = model.subgoal(state, c)
        path = returns.interpolate(state.centers, subgoal.centers, model.segment_length)
        progress = returns.advance(progress, reward, state.centers, path, state.mask)
        state = subgoal
    chance = ((progress.returns - BOUND) / temperature).exp()
    pyro.sample("optimal", Bernoulli(chance).to_event(1))


def scene(toy: SimpleNamespace, environments: int = 1) -> State:
    state: State = toy.scenes([[(0.5, 0.1), (0.7, -0.1)]] * environments, [1.0, 1.0])
    return state


def evidence_of(toy: SimpleNamespace, temperature: float, **options: Any) -> Evidence:
    """One estimate per environment."""
    optimizer = SequentialMonteCarlo(temperature=temperature, **options)
    horizon = 3 * SEGMENTS
    planner = toy.plain(small_model(), Near(toy), samples=SAMPLES, horizon=horizon, optimizer=optimizer)
    evidence: Evidence = planner.plan(scene(toy, RUNS), toy.generators(*range(RUNS))).evidence
    return evidence


@pytest.mark.soak
@pytest.mark.parametrize("temperature", [1.0, 2.0])
def test_importance_of_pyro_and_sequential_monte_carlo_agree(toy: SimpleNamespace, temperature: float) -> None:
    model, reward, state = small_model(), Near(toy), scene(toy)
    assert model.segment_length == 3
    pyro.set_rng_seed(0)
    optimal = poutine.condition(program, data={"optimal": torch.ones(1)})
    with torch.no_grad():
        found = Importance(optimal, num_samples=TRACES).run(model, reward, state, temperature)
    theirs = float(found.get_log_normalizer()) + BOUND / temperature
    spread = math.sqrt(TRACES / float(found.get_ESS()) - 1)  # of a weight, relative to the mean
    ours = evidence_of(toy, temperature)
    ratios = (ours.log_evidence - theirs).exp()
    error = math.hypot(spread / math.sqrt(TRACES), float(ratios.std()) / math.sqrt(RUNS))
    assert spread > 0.1  # plans do differ in their weights
    assert error < 0.05
    assert abs(float(ratios.mean()) - 1) < 3.5 * error


@pytest.mark.soak
def test_another_prior_is_found_out(toy: SimpleNamespace) -> None:
    # The same comparison, with codes of N(0, I) in the program: it must not agree.
    model, reward, state = small_model(), Near(toy), scene(toy)
    standard = StandardPrior(dimension=2, feature_dimension=1)
    other = SimpleNamespace(effect_prior=standard, subgoal=model.subgoal, segment_length=model.segment_length)
    pyro.set_rng_seed(0)
    optimal = poutine.condition(program, data={"optimal": torch.ones(1)})
    with torch.no_grad():
        found = Importance(optimal, num_samples=TRACES).run(other, reward, state, 2.0)
    theirs = float(found.get_log_normalizer()) + BOUND / 2.0
    spread = math.sqrt(TRACES / float(found.get_ESS()) - 1)
    ratios = (evidence_of(toy, 2.0).log_evidence - theirs).exp()
    error = math.hypot(spread / math.sqrt(TRACES), float(ratios.std()) / math.sqrt(RUNS))
    assert abs(float(ratios.mean()) - 1) > 6 * error
