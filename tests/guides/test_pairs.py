"""What holds of every model with each of its guides."""

from __future__ import annotations

import math
from collections.abc import Callable

import pyro
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from pyro import poutine
from pyro.infer import SVI, Predictive, RenyiELBO, Trace_ELBO
from torch import Tensor

from guides.guide import Guide
from models.model import Model
from models.state import State, Window
from tests.guides.pairs import DIMENSION, MISFITS, PAIRS, make, make_model, name_of

Pair = tuple[type[Model], type[Guide]]
every_pair = pytest.mark.parametrize("pair", PAIRS, ids=lambda pair: "-".join(map(name_of, pair)))


def double(window: Window) -> Window:
    return window.map(lambda tensor: tensor.double() if tensor.is_floating_point() else tensor)


def make_double(pair: Pair) -> tuple[Model, Guide]:
    model, guide = make(*pair)
    return model.double(), guide.double()


def loss_of(model: Model, guide: Guide, window: Window) -> Tensor:
    torch.manual_seed(5)
    return Trace_ELBO()(model, guide)(window)


@every_pair
def test_a_guide_samples_exactly_the_codes_of_its_model(pair: Pair, random_window: Callable[..., Window]) -> None:
    model, guide = make(*pair)
    window = random_window()
    in_model, in_guide = (poutine.trace(program).get_trace(window) for program in (model, guide))
    codes = [name for name in in_model.stochastic_nodes if name != "windows"]
    assert codes == [name for name in in_guide.stochastic_nodes if name != "windows"]
    assert codes == list(model.codes)
    for name in codes:
        assert in_guide.nodes[name]["fn"].shape() == in_model.nodes[name]["fn"].shape() == (4, DIMENSION[name])


@pytest.mark.parametrize(("model", "guide"), MISFITS, ids=name_of)
def test_every_other_pair_is_refused(model: type[Model], guide: type[Guide]) -> None:
    says = f"^guide {guide.__name__} does not fit model {model.__name__}; it fits {guide.fits[0]}$"
    with pytest.raises(ValueError, match=says):
        guide(make_model(model))


@every_pair
def test_no_parameter_is_held_twice_and_each_is_trained(pair: Pair, random_window: Callable[..., Window]) -> None:
    loss = Trace_ELBO()(*make(*pair))
    parameters = list(loss.parameters())
    assert len(parameters) == len({parameter.data_ptr() for parameter in parameters}) == len(loss.state_dict())
    loss(random_window()).backward()
    untrained = [name for name, parameter in loss.named_parameters() if parameter.grad is None]
    assert not untrained


@every_pair
def test_svi_with_the_global_store_trains_every_parameter(pair: Pair, random_window: Callable[..., Window]) -> None:
    window = random_window(batch=8)
    with pyro.settings.context(module_local_params=False):
        programs = make(*pair)
        named = {f"{n}.{name}": p for n, program in enumerate(programs) for name, p in program.named_parameters()}
        before = {name: parameter.detach().clone() for name, parameter in named.items()}
        svi = SVI(*programs, pyro.optim.Adam({"lr": 3e-3}), Trace_ELBO())
        losses = [svi.step(window) for _ in range(15)]
    assert not [name for name, parameter in named.items() if torch.equal(parameter, before[name])]
    assert sum(losses[-3:]) < sum(losses[:3])


@every_pair
@pytest.mark.parametrize("bound", [Trace_ELBO, RenyiELBO])
def test_vectorised_bounds_run_and_reach_every_parameter(
    pair: Pair, bound: type[Trace_ELBO] | type[RenyiELBO], random_window: Callable[..., Window]
) -> None:
    programs = make_double(pair)
    window = double(random_window())
    objective = bound(num_particles=8, vectorize_particles=True, max_plate_nesting=1)
    with pyro.settings.context(module_local_params=False):  # Renyi's gradients want to see parameters
        assert math.isfinite(objective.loss_and_grads(*programs, window))
    assert all(p.grad is not None and bool(p.grad.isfinite().all()) for q in programs for p in q.parameters())


@every_pair
def test_particles_have_codes_of_their_own_and_the_densities_of_each(
    pair: Pair, random_window: Callable[..., Window]
) -> None:
    programs, window = make_double(pair), double(random_window())
    with pyro.plate("particles", 8, dim=-2):
        guided = poutine.trace(programs[1]).get_trace(window)
        joint = poutine.trace(poutine.replay(programs[0], trace=guided)).get_trace(window)
    joint.compute_log_prob()
    for name, site in guided.iter_stochastic_nodes():
        if name in DIMENSION:
            assert site["value"].shape == (8, 4, DIMENSION[name])
            assert site["value"].std(0).min() > 0
    for name in joint.observation_nodes:
        assert joint.nodes[name]["log_prob"].shape == (8, 4)
        alone = one_particle(programs[0], guided, window).nodes[name]["log_prob"]
        assert torch.allclose(joint.nodes[name]["log_prob"][3], alone, rtol=1e-9)


def one_particle(model: Model, guided: poutine.Trace, window: Window) -> poutine.Trace:
    """The model's trace with the codes of particle 3."""
    codes = {name: guided.nodes[name]["value"][3] for name in DIMENSION if name in guided.nodes}
    traced = poutine.trace(poutine.condition(model, data=codes)).get_trace(window)
    traced.compute_log_prob()
    return traced


@every_pair
@settings(max_examples=8)
@given(order=st.permutations(range(4)))
def test_the_order_of_objects_leaves_the_loss(
    pair: Pair, order: list[int], random_window: Callable[..., Window]
) -> None:
    programs = make_double(pair)
    window = double(random_window())
    shuffled = window._replace(states=State(*(field[:, :, order] for field in window.states)))
    assert loss_of(*programs, shuffled).item() == pytest.approx(loss_of(*programs, window).item(), rel=1e-9)


@every_pair
@settings(max_examples=8)
@given(number=st.floats(-100, 100), kept=st.booleans())
def test_padding_leaves_the_loss(pair: Pair, number: float, kept: bool, random_window: Callable[..., Window]) -> None:
    programs = make_double(pair)
    window = double(random_window())
    states = window.states
    outside = ~states.mask.unsqueeze(-1)
    if kept:  # other numbers in the padding
        padded = [torch.where(outside, number, field) for field in states[:2]]
        other = window._replace(states=State(*padded, states.mask))
    else:  # the last object, which is padding throughout, cut off
        other = window._replace(states=State(*(field[:, :, :3] for field in states)))
    assert loss_of(*programs, other).item() == pytest.approx(loss_of(*programs, window).item(), rel=1e-9)


@every_pair
def test_codes_of_a_window_regenerate_it(pair: Pair, random_window: Callable[..., Window]) -> None:
    model, guide = make(*pair)
    sampled = Predictive(model, guide=guide, num_samples=6, parallel=True)(random_window(), generate=True)
    assert sampled["next_centers"].shape == (6, 4, 3, 4, 3)
    assert sampled["next_centers"].isfinite().all()
    assert ("actions" in sampled) == bool(model.codes)
    assert ("subgoal_centers" in sampled) == ("effect_code" in model.codes)
