"""Each pass changes the graph that it is for, and no result."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch
from torch import Tensor, nn
from torch.fx import Graph, GraphModule

from models.networks.contact.dynamics import ContactDynamics
from models.networks.encoder import StateEncoder
from models.networks.layers import fixed_shapes, relative_positions, unit
from models.priors.prior import SceneContext
from models.state import State
from planning.backends import passes
from planning.backends.passes import FEW
from planning.rollouts.returns import interpolate
from tests.tracing import traced


def changed(change: Callable[[Graph], None], function: Callable[..., Tensor], *values: Tensor) -> GraphModule:
    """What one pass makes of a function."""
    module = traced(function, *values)
    change(module.graph)
    module.graph.lint()
    module.recompile()
    return module


def rewritten(function: Callable[..., Tensor], *values: Tensor) -> GraphModule:
    """What all passes make of a function."""
    module = traced(function, *values)
    passes.rewrite(module)
    return module


def calls(module: GraphModule, name: str) -> int:
    """How often an operation of torch's is called, in all graphs."""
    parts = [part for part in module.modules() if isinstance(part, GraphModule)]
    return sum(f"aten.{name}." in str(node.target) for part in parts for node in part.graph.nodes)


@pytest.mark.parametrize("bias", [True, False])
@pytest.mark.parametrize("inputs", [1, 3, FEW, FEW + 1])
def test_a_linear_layer_of_few_inputs_is_no_product(inputs: int, bias: bool) -> None:
    torch.set_float32_matmul_precision("highest")
    layer, values = nn.Linear(inputs, 8, bias=bias), torch.randn(2, 5, inputs)
    module = changed(passes.expand_small_layers, layer, values)
    assert calls(module, "linear") == (inputs > FEW)
    torch.testing.assert_close(module(values), layer(values))


def test_it_is_not_rounded_where_products_are() -> None:
    layer, values = nn.Linear(3, 8), torch.randn(50, 3)
    exact = layer(values)
    with torch.autocast("cpu", torch.bfloat16):
        assert traced(layer, values)(values).dtype == torch.bfloat16
        torch.testing.assert_close(rewritten(layer, values)(values), exact)


def test_what_is_joined_is_rounded_as_it_was() -> None:
    few, many, positions, features = nn.Linear(3, 8), nn.Linear(6, 8), torch.randn(50, 3), torch.randn(50, 6)

    def joined(positions: Tensor, features: Tensor) -> Tensor:
        with torch.autocast("cpu", torch.bfloat16):
            return torch.cat((few(positions), many(features)), -1)

    found = rewritten(joined, positions, features)(positions, features)
    assert found.dtype == torch.bfloat16
    torch.testing.assert_close(found, joined(positions, features), atol=0.05, rtol=0.02)  # bfloat16 keeps 8 bits


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
@pytest.mark.parametrize("bias", [True, False])
def test_a_layer_of_few_and_many_numbers_does_not_join_them(order: tuple[int, int], bias: bool) -> None:
    torch.set_float32_matmul_precision("highest")
    layer, parts = nn.Linear(9, 8, bias=bias), (torch.randn(4, 3), torch.randn(4, 6))

    def of_both(few: Tensor, many: Tensor) -> Tensor:
        both = (few, many)
        return layer(torch.cat([both[number] for number in order], -1))

    module = changed(passes.split_concatenated_inputs, of_both, *parts)
    module.graph.eliminate_dead_code()
    module.recompile()
    assert (calls(traced(of_both, *parts), "cat"), calls(module, "cat")) == (1, 0)
    torch.testing.assert_close(module(*parts), of_both(*parts))


def test_a_layer_of_many_joined_numbers_stays() -> None:
    layer, parts = nn.Linear(12, 8), (torch.randn(4, 6), torch.randn(4, 6))
    module = changed(passes.split_concatenated_inputs, lambda *both: layer(torch.cat(both, -1)), *parts)
    assert calls(module, "cat") == 1


@pytest.mark.parametrize("function", [relative_positions, unit])
def test_a_division_by_what_is_shared_becomes_a_product(function: Callable[[Tensor], Tensor]) -> None:
    values = torch.cat([torch.randn(60, 3), torch.zeros(1, 3), torch.full((1, 3), 1e-20), torch.full((1, 3), 1e20)])
    module = changed(passes.invert_shared_divisors, function, values)
    assert (calls(traced(function, values), "div"), calls(module, "div")) == (1, 0)
    torch.testing.assert_close(module(values), function(values))
    nothing = torch.full_like(values, torch.nan)
    assert module(nothing).isnan().all()


def test_other_divisions_stay() -> None:
    start, end = torch.randn(2, 5, 3), torch.randn(2, 5, 3)
    assert calls(changed(passes.invert_shared_divisors, torch.div, torch.randn(100), torch.rand(100)), "div") == 1
    steps = changed(passes.invert_shared_divisors, lambda start, end: interpolate(start, end, 49), start, end)
    assert torch.equal(steps(start, end)[:, -1], end)  # 49 * (1 / 49) is not 1


def test_what_is_joined_along_time_lies_plan_by_plan() -> None:
    start, path = torch.randn(2, 7, 3, 3), torch.randn(2, 7, 4, 3, 3)

    def states(start: Tensor, path: Tensor) -> Tensor:
        return torch.cat([start.unsqueeze(-3), path], -3)

    found = changed(passes.move_plans_innermost, states, start, path)(start, path)
    assert torch.equal(found, states(start, path))
    assert found.stride() == (7, 1, 2 * 7 * 9, 2 * 7 * 3, 2 * 7)


def test_what_is_joined_otherwise_lies_as_it_did() -> None:
    objects, features = torch.randn(2, 7, 3, 3), torch.randn(2, 7, 3, 64)
    for dimension, values in ((-1, objects), (0, objects), (1, objects), (-2, features)):

        def joined(first: Tensor, second: Tensor, dimension: int = dimension) -> Tensor:
            return torch.cat([first, second], dimension)

        module = changed(passes.move_plans_innermost, joined, values, -values)
        assert module(values, -values).is_contiguous()


def test_a_copy_in_another_order_is_written_once() -> None:
    values = torch.randn(2, 7, 3, 5)
    moved = changed(passes.write_transposed_copies, lambda x: 2 * x.movedim(-1, 0).contiguous(), values)
    assert calls(moved, "contiguous") == 0
    assert torch.equal(moved(values), 2 * values.movedim(-1, 0))


def test_a_copy_of_a_part_in_the_same_order_stays() -> None:
    values = torch.randn(2, 7, 3, 5)
    assert calls(changed(passes.write_transposed_copies, lambda x: 2 * x[..., :2].contiguous(), values), "contiguous")


@pytest.mark.parametrize(("margin", "equivariant"), [(None, False), (0.35, False), (None, True)])
@pytest.mark.parametrize("objects", [2, *(pytest.param(count, marks=pytest.mark.soak) for count in (1, 4))])
def test_an_f_that_sees_contact_says_the_same(objects: int, margin: float | None, equivariant: bool) -> None:
    torch.set_float32_matmul_precision("highest")
    sizes = {"object_width": 16, "pair_width": 8, "shape_width": 8}
    f = ContactDynamics(**sizes, reach_margin=margin, equivariant=equivariant).double()
    features = torch.cat((0.1 * torch.randn(7, objects, 63), torch.ones(7, objects, 1)), -1)
    state = State(0.1 * torch.randn(7, objects, 3).double(), unit(features).double(), torch.rand(7, objects) < 0.7)
    action = torch.rand(7, 4).double()
    with fixed_shapes():
        module = rewritten(lambda action, *fields: f(State(*fields), None, action).centers, action, *state)
    torch.testing.assert_close(module(action, *state), f(state, None, action).centers)


def scenes(objects: int) -> State:
    """Seven scenes in float64, with padding in some."""
    mask = torch.rand(7, objects) < 0.7
    return State(torch.randn(7, objects, 3).double(), torch.randn(7, objects, 6).double(), mask)


@pytest.mark.parametrize("objects", [1, 2, 5])
def test_the_encoder_says_the_same(objects: int) -> None:
    encoder, state = StateEncoder(feature_dimension=6, width=8).double(), scenes(objects)
    module = rewritten(lambda *fields: encoder(State(*fields)), *state)
    assert calls(module, "linear") == objects  # of the features, and the second one of every pair
    torch.testing.assert_close(module(*state), encoder(state))


def test_a_learned_prior_says_the_same() -> None:
    context, state = SceneContext(feature_dimension=6, effect_dimension=None, width=8).double(), scenes(3)
    module = rewritten(lambda *fields: context(State(*fields), None), *state)
    torch.testing.assert_close(module(*state), context(state, None))
