from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import distributions, poutine
from pyro.infer import (
    JitTrace_ELBO,
    RenyiELBO,
    ReweightedWakeSleep,
    Trace_ELBO,
    TraceEnum_ELBO,
    TraceGraph_ELBO,
    TraceMeanField_ELBO,
)
from torch import Tensor, nn

from cavin_pyro.config.composition import compose
from cavin_pyro.config.parts import build_guide, build_model
from cavin_pyro.models.networks.layers import fixed_shapes
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.cuda_graphs import capturable, capturable_loss
from cavin_pyro.training.elbo import elbo_terms, term_counts
from cavin_pyro.training.objectives import Loss, Objective, as_objective, rollout_loss
from cavin_pyro.training.run import build_objective

Programs = tuple[nn.Module, nn.Module]
LATENT = {"nll_subgoal_centers", "nll_subgoal_features", "nll_actions", "kl_effect_code", "kl_motion_code"}
DYNAMICS = {"nll_next_centers", "nll_next_features"}
PARTICLES = {"num_particles": 4, "vectorize_particles": True, "max_plate_nesting": 1}


@pytest.fixture(autouse=True)
def as_in_training() -> Iterator[None]:
    unvalidated = {"validate_distributions_pyro": False, "validate_distributions_torch": False}
    with pyro.settings.context(module_local_params=True, **unvalidated):
        yield


@pytest.fixture
def programs(small: SimpleNamespace) -> Programs:
    parts = small.parts()
    return parts["model"].double(), parts["guide"].double()


@pytest.fixture
def window() -> Window:
    """Some windows and transitions do not count, and some objects are padding."""
    return windows(torch.float64)


def windows(dtype: torch.dtype) -> Window:
    generator = torch.Generator().manual_seed(5)
    centers = torch.rand(6, 4, 5, 3, generator=generator, dtype=torch.float64) * torch.tensor([0.4, 0.8, 0.1])
    features = nn.functional.normalize(torch.randn(6, 4, 5, 64, generator=generator, dtype=torch.float64), dim=-1)
    mask = (torch.arange(5) < torch.tensor([1, 2, 3, 4, 5, 5])[:, None, None]).expand(6, 4, 5)
    actions = 2 * torch.rand(6, 3, 4, generator=generator, dtype=torch.float64) - 1
    counts = torch.tensor([[True, True, True], [True, False, True], [False, True, True]]).repeat(2, 1)
    states = State(centers.to(dtype) + torch.tensor([0.35, -0.4, 0.0]), features.to(dtype), mask)
    return Window(states, actions.to(dtype), counts, torch.arange(6) != 2)


def loss_at(objective: Objective, programs: Programs, window: Window, step: int = 0) -> Tensor:
    torch.manual_seed(7)
    return objective.loss(*programs)(window, step)


def terms(programs: Programs, window: Window) -> dict[str, Tensor]:
    torch.manual_seed(7)
    return elbo_terms(*programs, window)


def gradients(loss: Tensor, programs: Programs) -> list[Tensor]:
    parameters = [parameter for program in programs for parameter in program.parameters()]
    return list(torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True))


def assert_same(loss: Tensor, expected: Tensor, programs: Programs, relative: float = 1e-6) -> None:
    """Value and gradients."""
    assert loss.item() == pytest.approx(expected.item(), rel=relative)
    for mine, theirs in zip(gradients(loss, programs), gradients(expected, programs), strict=True):
        assert torch.allclose(mine, theirs, rtol=relative, atol=relative * (1e-9 + float(theirs.abs().max())))


def test_terms_sum_to_pyros_loss_and_count_for_windows_or_transitions(programs: Programs, window: Window) -> None:
    found = terms(programs, window)
    assert found.keys() == LATENT | DYNAMICS
    assert_same(sum(found.values()), loss_at(Objective(Trace_ELBO(max_plate_nesting=1)), programs, window), programs)
    assert term_counts(found, window) == {**dict.fromkeys(LATENT, 5), **dict.fromkeys(DYNAMICS, 14)}
    assert not pyro.get_param_store().keys()
    none = window.map(torch.zeros_like)
    nothing = window._replace(transition_mask=none.transition_mask, sequence_mask=none.sequence_mask)
    assert {value.item() for value in elbo_terms(*programs, nothing).values()} == {0.0}


def test_weights_and_warm_up_weight_the_kl_terms_alone(programs: Programs, window: Window) -> None:
    objective = Objective(Trace_ELBO(max_plate_nesting=1), kl_weights={"motion_code": 2.0}, warm_up_steps=4)
    assert [objective.weights(step)["effect_code"] for step in (0, 1, 3, 4, 100)] == [0.25, 0.5, 1.0, 1.0, 1.0]
    assert [objective.weights(step)["motion_code"] for step in (0, 3)] == [0.5, 2.0]
    weights = {"kl_effect_code": 0.25, "kl_motion_code": 0.5}
    expected = sum(weights.get(name, 1.0) * value for name, value in terms(programs, window).items())
    assert_same(loss_at(objective, programs, window), expected, programs)


def test_the_mean_field_bound_weights_its_closed_forms_in_the_same_way(programs: Programs, window: Window) -> None:
    plain = loss_at(Objective(TraceMeanField_ELBO(max_plate_nesting=1)), programs, window)
    half = {"effect_code": 0.5, "motion_code": 0.5}
    weighted = loss_at(Objective(TraceMeanField_ELBO(max_plate_nesting=1), kl_weights=half), programs, window)
    torch.manual_seed(7)
    guided = poutine.trace(programs[1]).get_trace(window)
    joint = poutine.trace(poutine.replay(programs[0], trace=guided)).get_trace(window)
    each = [[trace.nodes[code]["fn"].base_dist for code in half] for trace in (guided, joint)]
    divergences = [torch.distributions.kl_divergence(q, p).sum(-1) for q, p in zip(*each, strict=True)]
    kl = sum(divergence[window.sequence_mask].sum() for divergence in divergences)
    assert (plain - weighted).item() == pytest.approx(0.5 * kl.item(), rel=1e-9)


@pytest.mark.parametrize("bound", [TraceGraph_ELBO, TraceEnum_ELBO])
def test_other_estimators_of_the_bound_give_its_value_and_gradients(
    programs: Programs, window: Window, bound: type[TraceGraph_ELBO]
) -> None:
    """All codes are reparameterised, none is discrete, so nothing is left for these to do in another way."""
    options = {"strict_enumeration_warning": False} if bound is TraceEnum_ELBO else {}
    loss = loss_at(Objective(bound(max_plate_nesting=1, **options), kl_weights={"motion_code": 3.0}), programs, window)
    expected = loss_at(Objective(Trace_ELBO(max_plate_nesting=1), kl_weights={"motion_code": 3.0}), programs, window)
    assert_same(loss, expected, programs)


def test_a_bound_with_gradients_of_its_own_leaves_those_that_exist(programs: Programs, window: Window) -> None:
    objective, bias = Objective(ReweightedWakeSleep(**PARTICLES)), programs[0].dynamics.change.head.bias
    bias.grad = torch.ones_like(bias)
    loss = loss_at(objective, programs, window)
    assert torch.equal(bias.grad, torch.ones_like(bias))
    assert any(bool(gradient.any()) for gradient in gradients(loss, programs))
    with torch.no_grad():
        assert loss_at(objective, programs, window).isfinite()
    assert not list(pyro.get_param_store())


def test_the_rollout_term_is_the_distance_of_predictions_from_predictions(programs: Programs, window: Window) -> None:
    model, total = programs[0], 0.0
    for number in range(6):
        state = State(*(field[number : number + 1] for field in window.first))
        for step in range(3):
            if not window.transition_mask[number, step]:
                break  # no later push is counted: f would start from a state that nothing was compared with
            state = model.next_state(state, window.actions[number : number + 1, step])
            real = window.first.mask[number]
            for field, unit in (("centers", 0.005), ("features", 0.1)):
                away = getattr(state, field)[0][real] - getattr(window.states, field)[number, step + 1][real]
                total += ((away**2).sum(-1) + 1e-6).sqrt().sum().item() / unit
    loss = rollout_loss(model, window)
    assert loss.item() == pytest.approx(total, rel=1e-9)
    found = torch.autograd.grad(loss, list(model.parameters()), allow_unused=True)
    named = zip(model.named_parameters(), found, strict=True)
    # The paper's f reads the state encoder.
    assert {name.split(".")[0] for (name, _), one in named if one is not None} == {"encoder", "dynamics"}
    plain, both = (Objective(Trace_ELBO(max_plate_nesting=1), rollout_weight=weight) for weight in (0.0, 0.3))
    difference = loss_at(both, programs, window) - loss_at(plain, programs, window)
    assert difference.item() == pytest.approx(0.3 * total, rel=1e-9)


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"kl_weights": {"code": 1.0}}, "kl_weights has no 'code'"),
        ({"kl_weights": {"effect_code": 0.0}}, "kl_weights.effect_code must be a number above 0"),
        ({"elbo": RenyiELBO(), "warm_up_steps": 10}, "has no KL terms to weight"),
        ({"elbo": JitTrace_ELBO()}, "JitTrace_ELBO compiles with torch.jit.trace"),
    ],
)
def test_an_invalid_objective_is_refused(options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Objective(**{"elbo": Trace_ELBO(), **options})


def test_a_plain_elbo_is_an_objective_and_nothing_else_is() -> None:
    bound = Trace_ELBO(num_particles=3)
    assert as_objective(bound).elbo is bound
    with pytest.raises(ValueError, match=r"objective must be of type Objective \| ELBO, not 3"):
        as_objective(3)


CONTACT = ("geometry=outline", "dynamics=contact", "scales=predicted", "prior=mixture", "objective=rollout")


def bound_loss(*options: str) -> Loss:
    config = compose("train", "model.width=8", *options)
    torch.manual_seed(0)
    model = build_model(config)
    return build_objective(config, model).loss(model, build_guide(config, model))


@pytest.mark.parametrize(
    "options",
    [
        (),
        CONTACT,
        ("model=single_latent", "guide=single_latent"),
        ("model=flat", "guide=flat", "prior=conditional"),
        ("model=dynamics", "guide=none"),
    ],
)
def test_the_loss_that_a_cuda_graph_captures_is_the_objective(options: tuple[str, ...]) -> None:
    whole, batch = bound_loss(*options), windows(torch.float32)
    assert capturable(whole, batch)
    torch.manual_seed(1)
    expected = whole(batch, 0)
    torch.manual_seed(1)
    with fixed_shapes():
        found = capturable_loss(whole, batch)
    assert_same(found, expected, (whole.model, whole.guide), relative=1e-3)


def test_other_losses_are_not_captured() -> None:
    batch = windows(torch.float32)
    for option in ("objective=iwae", "objective.warm_up_steps=10"):
        assert not capturable(bound_loss(option), batch)

    class Rough(distributions.Normal):
        has_rsample = False  # its loss has a term of the score function, and `elbo_terms` has no gradient of it

    def forward(window: Window, *_: object, **__: object) -> None:
        with pyro.plate("windows", len(window.actions)):
            for code in ("effect_code", "motion_code"):
                pyro.sample(code, Rough(torch.zeros(16), torch.ones(16)).to_event(1))

    whole = bound_loss()
    whole.guide.forward = forward  # type: ignore[method-assign]
    assert not capturable(whole, batch)
