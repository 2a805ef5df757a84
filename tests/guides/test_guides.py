"""What holds of every model with each of its guides, of flows, and of the inference networks."""

from __future__ import annotations

from collections.abc import Callable

import pyro
import pytest
import torch
from pyro import poutine
from pyro.infer import SVI, Trace_ELBO, TraceMeanField_ELBO
from torch import Tensor, nn

from cavin_pyro.guides.cascaded import CascadedGuide
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import State, Window
from tests.guides.programs import DIMENSION, PAIRS, make

Pair = tuple[str, str]
every_pair = pytest.mark.parametrize("pair", PAIRS, ids="-".join)


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
    assert codes == [name for name in in_guide.stochastic_nodes if name != "windows"] == list(model.codes)
    for name in codes:
        assert in_guide.nodes[name]["fn"].shape() == in_model.nodes[name]["fn"].shape() == (4, DIMENSION[name])


@every_pair
def test_no_parameter_is_held_twice_and_each_is_trained(pair: Pair, random_window: Callable[..., Window]) -> None:
    loss = Trace_ELBO()(*make(*pair))
    parameters = list(loss.parameters())
    assert len(parameters) == len({parameter.data_ptr() for parameter in parameters})
    loss(random_window()).backward()
    assert not [name for name, parameter in loss.named_parameters() if parameter.grad is None]


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
def test_particles_have_codes_of_their_own_and_the_densities_of_each(pair: Pair, window: Window) -> None:
    model, guide = make_double(pair)
    with pyro.plate("particles", 8, dim=-2):
        guided = poutine.trace(guide).get_trace(window)
        joint = poutine.trace(poutine.replay(model, trace=guided)).get_trace(window)
    joint.compute_log_prob()
    codes = {name: guided.nodes[name]["value"] for name in model.codes}
    assert all(code.shape == (8, 4, DIMENSION[name]) and code.std(0).min() > 0 for name, code in codes.items())
    alone = poutine.trace(poutine.condition(model, data={name: code[3] for name, code in codes.items()}))
    one = alone.get_trace(window)
    one.compute_log_prob()
    for name in joint.observation_nodes:
        assert joint.nodes[name]["log_prob"].shape == (8, 4)
        assert torch.allclose(joint.nodes[name]["log_prob"][3], one.nodes[name]["log_prob"], rtol=1e-9)


@every_pair
def test_order_of_objects_and_padding_leave_the_loss(pair: Pair, window: Window) -> None:
    programs, states = make_double(pair), window.states
    expected = pytest.approx(loss_of(*programs, window).item(), rel=1e-9)
    outside = ~states.mask.unsqueeze(-1)
    others = [states.map(lambda field, order=order: field[:, :, order]) for order in ([2, 3, 0, 1], [3, 2, 1, 0])]
    others += [states.map(lambda field: field[:, :, :3])]  # the last object, which is padding throughout, cut off
    others += [State(*(torch.where(outside, number, f) for f in states[:2]), states.mask) for number in (-70.0, 9.0)]
    for other in others:
        assert loss_of(*programs, window._replace(states=other)).item() == expected


@every_pair
@torch.no_grad()
def test_features_are_computed_once_for_model_and_guide_and_are_those_of_each(
    pair: Pair, random_window: Callable[..., Window]
) -> None:
    model, guide = make(*pair)
    window, other, calls = random_window(), random_window(), []
    model.encoder.register_forward_hook(lambda *given: calls.append(given))
    expected = loss_of(model, guide, window).item(), loss_of(model, guide, other).item()
    calls.clear()
    with model.encoding(window):
        assert loss_of(model, guide, window).item() == expected[0] and len(calls) == 1
        assert loss_of(model, guide, other).item() == expected[1]  # another window has features of its own
    assert len(calls) >= 2


def test_a_flow_guide_begins_as_the_plain_guide_and_every_weight_learns(window: Window) -> None:
    model, guide = make_double(("cascaded", "flow"))
    plain = CascadedGuide(model, width=8).double()
    weights = guide.state_dict().items()
    plain.load_state_dict({name.replace(".gaussian", ""): value for name, value in weights if ".flow." not in name})
    assert loss_of(model, guide, window).item() == pytest.approx(loss_of(model, plain, window).item(), rel=1e-12)
    for name, parameter in guide.named_parameters():
        if ".flow." in name:
            nn.init.normal_(parameter, std=0.3)
    loss = loss_of(model, guide, window)
    assert loss.item() != pytest.approx(loss_of(model, plain, window).item(), rel=1e-6)
    torch.manual_seed(5)
    assert TraceMeanField_ELBO()(model, guide)(window).item() == pytest.approx(loss.item(), rel=1e-12)
    loss.backward()
    assert not [name for name, one in guide.named_parameters() if one.grad is None or not one.grad.any()]
