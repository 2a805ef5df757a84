"""What layers compute in native code, they compute otherwise, and to the same numbers."""

from __future__ import annotations

import pytest
import torch
from torch.nn import functional

from models.layers import FEW, Linear, relative_positions, unit
from tests.tracing import traced


def products(graph: torch.fx.GraphModule) -> int:
    return sum("linear" in str(node.target) for node in graph.graph.nodes)


@pytest.mark.parametrize("inputs", [1, 3, FEW, FEW + 1])
def test_a_linear_layer_of_few_inputs_is_compiled_without_a_product_to_the_same_numbers(inputs: int) -> None:
    torch.set_float32_matmul_precision("highest")
    layer, values = Linear(inputs, 8), torch.randn(2, 5, inputs)
    assert products(traced(layer, values)) == (inputs > FEW)
    torch.testing.assert_close(traced(layer, values)(values), layer(values))


@pytest.mark.parametrize("inputs", [3, FEW + 1])
def test_it_rounds_its_results_as_products_do(inputs: int) -> None:
    layer, values = Linear(inputs, 8), torch.randn(5, inputs)
    exact = layer(values)
    with torch.autocast("cpu", torch.bfloat16):
        rounded = traced(layer, values)(values)
    assert rounded.dtype == torch.bfloat16
    torch.testing.assert_close(rounded.float(), exact, atol=0.05, rtol=0.02)  # bfloat16 keeps 8 bits


def test_positions_and_unit_vectors_are_compiled_to_the_same_numbers() -> None:
    values = torch.cat([torch.randn(6, 3), torch.zeros(1, 3), 1e-20 * torch.ones(1, 3)])
    torch.testing.assert_close(traced(relative_positions, values)(values), relative_positions(values))
    torch.testing.assert_close(unit(values), functional.normalize(values, dim=-1))
    torch.testing.assert_close(traced(unit, values)(values), unit(values))
    nothing = torch.full((1, 3), torch.nan)
    assert traced(unit, nothing)(nothing).isnan().all()
