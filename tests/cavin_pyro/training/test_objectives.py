from __future__ import annotations

from types import SimpleNamespace

import pyro
import pytest
import torch
from pyro import poutine
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

from cavin_pyro.training.counterfactual import counterfactual_loss
from cavin_pyro.training.elbo import elbo_terms
from cavin_pyro.training.objectives import Objective, as_objective
from cavin_pyro.training.renyi import DifferentiableRenyiELBO
from cavin_pyro.training.rollout import rollout_loss
from models.state import State, Window

KL = {"kl_effect_code", "kl_motion_code"}


@pytest.fixture
def programs(small: SimpleNamespace) -> tuple[nn.Module, nn.Module]:
    parts = small.parts()
    return parts["model"].double(), parts["guide"].double()


@pytest.fixture
def window() -> Window:
    generator = torch.Generator().manual_seed(5)
    centers = torch.rand(6, 4, 5, 3, generator=generator, dtype=torch.float64)
    features = nn.functional.normalize(torch.randn(6, 4, 5, 64, generator=generator, dtype=torch.float64), dim=-1)
    mask = (torch.arange(5) < torch.tensor([1, 2, 3, 4, 5, 5])[:, None, None]).expand(6, 4, 5)
    actions = 2 * torch.rand(6, 3, 4, generator=generator, dtype=torch.float64) - 1
    return Window(State(centers, features, mask), actions, torch.ones(6, 3, dtype=torch.bool), torch.arange(6) != 2)


def loss_at(objective: Objective, programs: tuple[nn.Module, nn.Module], window: Window, step: int = 0) -> Tensor:
    torch.manual_seed(7)
    return objective.bind(*programs)(window, step)


def terms(programs: tuple[nn.Module, nn.Module], window: Window) -> dict[str, Tensor]:
    torch.manual_seed(7)
    return elbo_terms(*programs, window)


def gradients(loss: Tensor, programs: tuple[nn.Module, nn.Module]) -> list[Tensor]:
    parameters = [parameter for program in programs for parameter in program.parameters()]
    return list(torch.autograd.grad(loss, parameters, allow_unused=True, materialize_grads=True))


def assert_same_gradients(one: Tensor, other: Tensor, programs: tuple[nn.Module, nn.Module]) -> None:
    for mine, theirs in zip(gradients(one, programs), gradients(other, programs), strict=True):
        assert torch.allclose(mine, theirs, rtol=1e-6, atol=1e-6 * float(theirs.abs().max()))


def test_the_default_objective_is_the_bound_and_nothing_else(programs: tuple, window: Window) -> None:
    loss = loss_at(Objective(Trace_ELBO(max_plate_nesting=1)), programs, window)
    assert loss.item() == pytest.approx(sum(value.item() for value in terms(programs, window).values()), rel=1e-9)


def test_kl_weights_weight_the_kl_terms_alone(programs: tuple, window: Window) -> None:
    objective = Objective(Trace_ELBO(max_plate_nesting=1), kl_weights={"effect_code": 0.5, "motion_code": 3.0})
    weights = {"kl_effect_code": 0.5, "kl_motion_code": 3.0}
    expected = sum(weights.get(name, 1.0) * value for name, value in terms(programs, window).items())
    loss = loss_at(objective, programs, window)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    assert_same_gradients(loss, expected, programs)


def test_the_mean_field_bound_weights_its_closed_forms_in_the_same_way(programs: tuple, window: Window) -> None:
    plain = loss_at(Objective(TraceMeanField_ELBO(max_plate_nesting=1)), programs, window)
    half = {"effect_code": 0.5, "motion_code": 0.5}
    weighted = loss_at(Objective(TraceMeanField_ELBO(max_plate_nesting=1), kl_weights=half), programs, window)
    torch.manual_seed(7)
    guided = poutine.trace(programs[1]).get_trace(window)
    joint = poutine.trace(poutine.replay(programs[0], trace=guided)).get_trace(window)
    kl = sum(
        torch.distributions.kl_divergence(guided.nodes[code]["fn"].base_dist, joint.nodes[code]["fn"].base_dist)
        .sum(-1)[window.sequence_mask]
        .sum()
        for code in ("effect_code", "motion_code")
    )
    assert (plain - weighted).item() == pytest.approx(0.5 * kl.item(), rel=1e-9)


def test_warm_up_raises_the_weights_step_by_step_to_where_they_belong(programs: tuple, window: Window) -> None:
    objective = Objective(Trace_ELBO(max_plate_nesting=1), kl_weights={"motion_code": 2.0}, warm_up_steps=4)
    assert [objective.weights(step)["effect_code"] for step in (0, 1, 3, 4, 100)] == [0.25, 0.5, 1.0, 1.0, 1.0]
    assert [objective.weights(step)["motion_code"] for step in (0, 3)] == [0.5, 2.0]
    losses = terms(programs, window)
    expected = sum(value for name, value in losses.items() if name not in KL)
    expected = expected + 0.25 * losses["kl_effect_code"] + 0.5 * losses["kl_motion_code"]
    assert loss_at(objective, programs, window).item() == pytest.approx(expected.item(), rel=1e-9)


def particle_losses(programs: tuple, window: Window, particles: int) -> Tensor:
    """-log p(x, c, z) / q(c, z), [K, B], one particle and one window at a time, with the noise of `loss_at`."""
    model, guide = programs
    torch.manual_seed(7)
    noise = {
        code: torch.randn(particles, len(window.actions), 4, dtype=torch.float64)
        for code in ("effect_code", "motion_code")
    }
    losses = []
    for particle in range(particles):
        for number in range(len(window.actions)):
            one = window.map(lambda tensor, number=number: tensor[number : number + 1])
            drawn = {}

            def code(name: str, one=one, drawn=drawn) -> Tensor:
                traced = poutine.trace(poutine.condition(guide, data=drawn)).get_trace(one)
                return traced.nodes[name]["fn"].base_dist

            for name in ("effect_code", "motion_code"):
                gaussian = code(name)
                drawn[name] = gaussian.loc + gaussian.scale * noise[name][particle, number]
            guided = poutine.trace(poutine.condition(guide, data=drawn)).get_trace(one)
            joint = poutine.trace(poutine.condition(model, data=drawn)).get_trace(one)
            losses.append(guided.log_prob_sum() - joint.log_prob_sum())
    return torch.stack(losses).view(particles, len(window.actions))


@pytest.mark.parametrize("bound", [TraceGraph_ELBO, TraceEnum_ELBO])
def test_other_estimators_of_the_bound_give_its_value_and_gradients(
    programs: tuple, window: Window, bound: type[TraceGraph_ELBO]
) -> None:
    """All codes are reparameterised, none is discrete, so nothing is left for these to do in another way."""
    options = {"strict_enumeration_warning": False} if bound is TraceEnum_ELBO else {}
    objective = Objective(bound(max_plate_nesting=1, **options), kl_weights={"motion_code": 3.0})
    loss = loss_at(objective, programs, window)
    expected = loss_at(Objective(Trace_ELBO(max_plate_nesting=1), kl_weights={"motion_code": 3.0}), programs, window)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    assert_same_gradients(loss, expected, programs)


def test_pyros_own_renyi_bound_has_our_gradients(programs: tuple, window: Window) -> None:
    options = {"num_particles": 4, "vectorize_particles": True, "max_plate_nesting": 1}
    loss = loss_at(Objective(RenyiELBO(alpha=0.5, **options)), programs, window)
    expected = loss_at(Objective(DifferentiableRenyiELBO(alpha=0.5, **options)), programs, window)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    assert_same_gradients(loss, expected, programs)


def test_a_bound_with_gradients_of_its_own_leaves_those_that_exist(programs: tuple, window: Window) -> None:
    bound = ReweightedWakeSleep(num_particles=2, vectorize_particles=True, max_plate_nesting=1)
    bias = programs[0].dynamics.change.head.bias
    bias.grad = torch.ones_like(bias)
    loss = loss_at(Objective(bound), programs, window)
    assert torch.equal(bias.grad, torch.ones_like(bias))
    assert any(bool(gradient.abs().max() > 0) for gradient in gradients(loss, programs))
    with torch.no_grad():
        assert loss_at(Objective(bound), programs, window).isfinite()
    assert not list(pyro.get_param_store())


@pytest.mark.parametrize("alpha", [0.0, 0.5])
def test_the_renyi_bound_is_taken_window_by_window(programs: tuple, window: Window, alpha: float) -> None:
    bound = DifferentiableRenyiELBO(alpha=alpha, num_particles=3, vectorize_particles=True, max_plate_nesting=1)
    loss = loss_at(Objective(bound), programs, window)
    weights = -(1 - alpha) * particle_losses(programs, window, 3)
    largest = weights.max(0).values.detach()
    expected = -(largest + (weights - largest).exp().mean(0).log()).sum() / (1 - alpha)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    assert_same_gradients(loss, expected, programs)


def test_the_renyi_bound_equals_pyros_own(programs: tuple, window: Window) -> None:
    options = {"num_particles": 8, "vectorize_particles": True, "max_plate_nesting": 1}
    torch.manual_seed(7)
    theirs = RenyiELBO(alpha=0.0, **options).loss(*programs, window)
    ours = loss_at(Objective(DifferentiableRenyiELBO(alpha=0.0, **options)), programs, window)
    assert ours.item() == pytest.approx(theirs, rel=1e-9)


def test_more_particles_give_a_tighter_bound(programs: tuple, window: Window) -> None:
    losses = []
    for particles in (1, 50):
        bound = DifferentiableRenyiELBO(
            alpha=0.0, num_particles=particles, vectorize_particles=True, max_plate_nesting=1
        )
        losses.append(loss_at(Objective(bound), programs, window).item())
    assert losses[1] < losses[0] - 1


def test_the_counterfactual_term_rolls_generated_pushes_through_the_dynamics(programs: tuple, window: Window) -> None:
    model, _ = programs
    codes = {code: torch.randn(6, 4, dtype=torch.float64) for code in ("effect_code", "motion_code")}
    pushes = model.actions(window.first, **codes)
    total = torch.zeros((), dtype=torch.float64)
    for number in range(6):
        if not window.sequence_mask[number]:
            continue
        state = State(*(field[number : number + 1] for field in window.first))
        for step in range(3):
            state = model.next_state(state, pushes[number : number + 1, step])
        real = window.first.mask[number]
        for field, scale in (("centers", 0.01), ("features", 0.1)):
            mean, observed = getattr(state, field)[0][real], getattr(window.last, field)[number][real]
            total = total - torch.distributions.Normal(mean, scale).log_prob(observed).sum()
    assert counterfactual_loss(model, window, codes).item() == pytest.approx(total.item(), rel=1e-9)


def test_the_counterfactual_term_uses_the_codes_of_the_bound(programs: tuple, window: Window) -> None:
    objective = Objective(Trace_ELBO(max_plate_nesting=1), counterfactual_weight=0.3)
    torch.manual_seed(7)
    guided = poutine.trace(programs[1]).get_trace(window)
    codes = {code: guided.nodes[code]["value"] for code in ("effect_code", "motion_code")}
    expected = sum(terms(programs, window).values()) + 0.3 * counterfactual_loss(programs[0], window, codes)
    loss = loss_at(objective, programs, window)
    assert loss.item() == pytest.approx(expected.item(), rel=1e-9)
    assert_same_gradients(loss, expected, programs)


def test_the_rollout_term_is_the_distance_of_predictions_from_predictions(programs: tuple, window: Window) -> None:
    model, _ = programs
    counts = torch.tensor([[True, True, True], [True, False, True], [False, True, True]]).repeat(2, 1)
    window = window._replace(transition_mask=counts)
    total = 0.0
    for number in range(6):
        state = State(*(field[number : number + 1] for field in window.first))
        for step in range(3):
            if not counts[number, step]:
                break  # no later push is counted: f would start from a state that nothing was compared with
            state = model.next_state(state, window.actions[number : number + 1, step])
            real = window.first.mask[number]
            for field, unit in (("centers", 0.005), ("features", 0.1)):
                away = getattr(state, field)[0][real] - getattr(window.states, field)[number, step + 1][real]
                total += ((away**2).sum(-1) + 1e-6).sqrt().sum().item() / unit
    assert rollout_loss(model, window).item() == pytest.approx(total, rel=1e-9)


def test_the_rollout_term_is_added_to_the_bound_and_reaches_f_alone(programs: tuple, window: Window) -> None:
    plain = loss_at(Objective(Trace_ELBO(max_plate_nesting=1)), programs, window)
    both = loss_at(Objective(Trace_ELBO(max_plate_nesting=1), rollout_weight=0.3), programs, window)
    assert (both - plain).item() == pytest.approx(0.3 * rollout_loss(programs[0], window).item(), rel=1e-9)
    model = programs[0]
    found = torch.autograd.grad(rollout_loss(model, window), list(model.parameters()), allow_unused=True)
    reached = {
        name.split(".")[0] for (name, _), one in zip(model.named_parameters(), found, strict=True) if one is not None
    }
    assert reached == {"encoder", "dynamics"}  # the paper's f reads the state encoder


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"kl_weights": {"code": 1.0}}, "kl_weights has no 'code': choose from effect_code, motion_code"),
        ({"kl_weights": {"effect_code": 0.0}}, "kl_weights.effect_code must be positive, not 0"),
        ({"warm_up_steps": -1}, "objective.warm_up_steps must be 0 or more, not -1"),
        ({"counterfactual_weight": -0.1}, "objective.counterfactual_weight must be 0 or more, not -0.1"),
        ({"rollout_weight": float("nan")}, "objective.rollout_weight must be 0 or more, not nan"),
        ({"elbo": Trace_ELBO(num_particles=2), "counterfactual_weight": 1.0}, "takes one particle, not 2"),
        ({"elbo": RenyiELBO(), "kl_weights": {"effect_code": 0.5}}, "has no KL terms to weight"),
        ({"elbo": RenyiELBO(), "warm_up_steps": 10}, "has no KL terms to weight"),
        ({"elbo": JitTrace_ELBO()}, "JitTrace_ELBO compiles with torch.jit.trace, .* choose objective=trace_elbo"),
        ({"elbo": TraceGraph_ELBO(), "counterfactual_weight": 1.0}, "takes objective.elbo Trace_ELBO"),
    ],
)
def test_an_invalid_objective_is_refused(options: dict, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Objective(**{"elbo": Trace_ELBO(), **options})


def test_a_plain_elbo_is_an_objective_and_nothing_else_is() -> None:
    bound = Trace_ELBO(num_particles=3)
    assert as_objective(bound).elbo is bound
    with pytest.raises(ValueError, match="or an ELBO of Pyro, not int"):
        as_objective(3)


def test_particles_of_the_renyi_bound_are_vectorised(programs: tuple, window: Window) -> None:
    with pytest.raises(ValueError, match="set vectorize_particles=true"):
        loss_at(Objective(DifferentiableRenyiELBO(num_particles=2)), programs, window)


@pytest.fixture(autouse=True)
def module_local() -> None:
    pyro.settings.set(module_local_params=True)
