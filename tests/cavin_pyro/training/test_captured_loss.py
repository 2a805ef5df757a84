"""The loss of a step as a CUDA graph, without a GPU: its value and its gradients are those of the eager loss."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pyro
import pytest
import torch
from pyro import distributions
from pyro.infer import Trace_ELBO
from torch import Tensor, nn

from cavin_pyro.config.composition import compose
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.training.cuda_graphs import CapturedLoss, capturable, loss_of
from cavin_pyro.training.factory import build_objective
from cavin_pyro.training.objectives import BoundObjective, Objective
from models.networks.shapes import fixed_shapes
from models.state import State, Window
from planning.backends import capture as capturing

CONTACT = ["geometry=outline", "dynamics=contact", "dynamics.reach_margin=0.015", "scales=predicted", "prior=mixture"]
CHOICES = {
    "default": [],
    "contact": [*CONTACT, "objective=rollout"],
    "equivariant": [*CONTACT, "dynamics.equivariant=true", "objective=consistent", "objective.rollout_weight=1"],
    "single_latent": ["model=single_latent", "guide=single_latent"],
    "flat": ["model=flat", "guide=flat", "prior=conditional"],
    "dynamics": ["model=dynamics", "guide=none"],
    "joint": ["guide=joint"],
    "mean_field": ["guide=mean_field"],
    "learned": ["scales=learned"],
}


@pytest.fixture(autouse=True)
def _unchecked() -> Any:
    with pyro.settings.context(
        module_local_params=True, validate_distributions_pyro=False, validate_distributions_torch=False
    ):
        yield


def loss(*options: str) -> BoundObjective:
    config = compose("train", "model.width=8", *options)
    torch.manual_seed(0)
    model = build_model(config)
    return build_objective(config, model).bind(model, build_guide(config, model))


def window(seed: int = 0, objects: int = 3, count: int = 6) -> Window:
    generator = torch.Generator().manual_seed(seed)
    centers = torch.rand(count, 4, objects, 3, generator=generator) * torch.tensor([0.4, 0.8, 0.1])
    centers = centers + torch.tensor([0.35, -0.4, 0.0])
    features = nn.functional.normalize(torch.randn(count, 4, objects, 64, generator=generator), dim=-1)
    mask = (torch.arange(objects) < torch.arange(count)[:, None, None] % objects + 1).expand(count, 4, objects)
    actions = 2 * torch.rand(count, 3, 4, generator=generator) - 1
    counts = torch.arange(count) != 2
    return Window(State(centers, features, mask), actions, counts.unsqueeze(-1).expand(-1, 3), counts)


def gradients(value: Tensor, loss: BoundObjective) -> list[Tensor]:
    return list(torch.autograd.grad(value, list(loss.parameters()), allow_unused=True, materialize_grads=True))


@pytest.mark.parametrize("name", CHOICES)
def test_the_loss_that_is_captured_is_the_objective_with_its_gradients(name: str) -> None:
    whole, batch = loss(*CHOICES[name]), window()
    assert capturable(whole, batch)
    torch.manual_seed(1)
    expected = whole(batch, 0)
    torch.manual_seed(1)
    with fixed_shapes():
        found = loss_of(whole, batch)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-4)
    for mine, other in zip(gradients(found, whole), gradients(expected, whole), strict=True):
        torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4 * (1 + other.abs().max().item()))


@pytest.mark.parametrize(
    "options",
    [
        ["objective=iwae"],
        ["objective=renyi"],
        ["objective=counterfactual"],
        ["objective=trace_graph_elbo"],
        ["objective.warm_up_steps=10"],
        ["objective.kl_weights.effect_code=0.5"],
        ["objective.elbo.num_particles=2"],
        ["guide=auto_normal"],
    ],
)
def test_other_losses_are_not_captured(options: list[str]) -> None:
    whole, batch = loss(*options), window()
    if not whole.guide.amortized:
        batch = batch._replace(sequence_mask=torch.ones_like(batch.sequence_mask))
        whole.guide(batch)
    assert not capturable(whole, batch)


def test_codes_without_gradients_are_not_captured() -> None:
    """Their loss has a term more, of the score function, and `elbo_terms` has no gradient of it."""

    class Rough(distributions.Normal):
        has_rsample = False

    whole = loss()

    def forward(window: Window, *_: Any, **__: Any) -> None:
        with pyro.plate("windows", len(window.actions)):
            pyro.sample("effect_code", Rough(torch.zeros(16), torch.ones(16)).to_event(1))
            pyro.sample("motion_code", Rough(torch.zeros(16), torch.ones(16)).to_event(1))

    assert capturable(whole, window())
    whole.guide.forward = forward  # type: ignore[method-assign]
    assert not capturable(whole, window())


def test_replays_give_each_batch_its_own_loss_and_gradients(monkeypatch: pytest.MonkeyPatch) -> None:
    """Also after the caller has clipped them in place, and for batches of another shape in between."""
    whole, count = loss("model=dynamics", "guide=none"), 0

    def capture(function: Callable[[], Any], device: torch.device, pool: Any) -> tuple[Any, Any]:
        nonlocal count
        count += 1
        value, found = function()

        def replay() -> None:
            new, others = function()
            value.copy_(new)
            for mine, other in zip(found, others, strict=True):
                assert (mine is None) == (other is None)
                if mine is not None:
                    mine.copy_(other)

        return SimpleNamespace(replay=replay), (value, found)

    monkeypatch.setattr(capturing, "capture", capture)
    monkeypatch.setattr(torch.cuda, "graph_pool_handle", lambda: None)
    step = CapturedLoss(whole)
    for seed, objects in ((0, 3), (1, 2), (2, 3), (3, 2)):
        batch = window(seed, objects)
        expected = whole(batch, 0) / 6
        found = step(batch)
        assert not found.requires_grad and found.item() == pytest.approx(expected.item(), rel=1e-5)
        for parameter, other in zip(whole.parameters(), gradients(expected, whole), strict=True):
            mine = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
            torch.testing.assert_close(mine, other, rtol=1e-4, atol=1e-4)
        nn.utils.clip_grad_norm_(whole.parameters(), 1e-3)
    assert count == 2


def test_a_users_own_bound_and_objective_are_not_captured() -> None:
    class Mine(Trace_ELBO):
        pass

    class Later(Objective):
        def weights(self, step: int) -> dict[str, float]:
            return dict.fromkeys(("effect_code", "motion_code"), 1.0 if step == 0 else 0.1)

    whole = loss()
    for own in (Objective(Mine(max_plate_nesting=1)), Later(Trace_ELBO(max_plate_nesting=1))):
        assert not capturable(own.bind(whole.model, whole.guide), window())
