"""Passes that rewrite exported graphs, so that torch's Inductor generates fast code.

Models, priors, rewards and planners have one body each, written as in the paper, which the eager backend runs
unchanged. These passes transform the graph that `torch.export` makes of that body. Every pass changes a graph in place;
results stay the same up to rounding of sums. Inductor does the rest by option (`planning.backends.compiled.COMPILING`):
for example, it unrolls the minima over a layout's rectangles.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import reduce
from operator import add
from typing import Any

import torch
from torch import Tensor
from torch.fx import Graph, GraphModule, Node, Proxy
from torch.fx.proxy import GraphAppendingTracer
from torch.nn import functional

aten: Any = torch.ops.aten

FEW = 4  # inputs of a small layer, at most: x, y and z, or a push
EXACT = 64  # divisions of at most as many numbers stay: they cost little, and are exact


def rewrite(module: GraphModule) -> None:
    """Apply all passes to a graph and its subgraphs (`torch.autocast` makes one of the operations that it rounds)."""
    for part in module.modules():
        if isinstance(part, GraphModule):
            for change in PASSES:
                change(part.graph)
            part.recompile()


def drop_checks(graph: Graph) -> None:
    """Remove the type checks that export adds: `expand_small_layers` changes some types on purpose."""
    for node in _calls(graph, aten._assert_tensor_metadata.default):
        graph.erase_node(node)


def expand_small_layers(graph: Graph) -> None:
    """Replace a linear layer of few inputs by a sum of products, always in float32.

    A call of a matrix product costs 30 microseconds, even for small ones. The sum costs little more than writing the
    result, if each input is read from memory (hence the copy) and not recomputed for each output.
    """
    for node in _calls(graph, aten.linear.default):
        inputs, weight, *bias = _arguments(node)
        count = _value(weight).shape[-1]
        if count <= FEW:
            with _before(node) as tensor:
                products = _products(_written(tensor(inputs)), tensor(weight), count)
                _replace(node, reduce(add, [*map(tensor, bias), *products]))


def split_concatenated_inputs(graph: Graph) -> None:
    """Split a linear layer of concatenated inputs into a layer of the wide input and products of the narrow ones.

    This avoids the concatenation; the products are added where the sum is read anyway. The first layer of a learned
    prior reads a position and 64 features.
    """
    for node in _calls(graph, aten.linear.default):
        inputs, weight, *bias = _arguments(node)
        parts = _joined(inputs)
        few = [part for part in parts if _value(part).shape[-1] <= FEW]
        if not few or len(parts) - len(few) != 1:
            continue
        layer, products, begin = None, [], 0
        with _before(node) as tensor:
            for part in parts:
                end = begin + _value(part).shape[-1]
                if part in few:
                    products += _products(tensor(part), tensor(weight)[:, begin:end], end - begin)
                else:
                    layer = functional.linear(tensor(part), tensor(weight)[:, begin:end], *map(tensor, bias))
                begin = end
            _replace(node, reduce(add, products, layer))


def round_concatenated(graph: Graph) -> None:
    """Round the inputs of concatenations in bfloat16: float32 of `expand_small_layers` has twice the memory traffic."""
    for node in _calls(graph, aten.cat.default):
        if _value(node).dtype == torch.bfloat16:
            parts, *dimension = _arguments(node)
            with _before(node) as tensor:
                _replace(node, torch.cat([tensor(part).to(torch.bfloat16) for part in parts], *dimension))


def invert_shared_divisors(graph: Graph) -> None:
    """Replace a division by a broadcast divisor by a product with its reciprocal.

    A division takes several times as long as a product. Examples: 64 features by one length, positions by a unit.
    """
    for node in _calls(graph, aten.div.Tensor):
        dividend, divisor = _arguments(node)
        while isinstance(divisor, Node) and divisor.target in (aten.expand.default, aten.expand_as.default):
            divisor = divisor.args[0]
        own = isinstance(divisor, Node) and _value(divisor).numel() == _value(node).numel()
        if not own and _value(node).numel() > EXACT:
            with _before(node) as tensor:
                inverse = tensor(divisor).reciprocal() if isinstance(divisor, Node) else 1 / divisor
                _replace(node, tensor(dividend) * inverse)


def move_plans_innermost(graph: Graph) -> None:
    """Lay out a concatenation along time in memory with the plans innermost.

    Vectorised code computes sixteen numbers at a time if they are adjacent in memory. Of paths `[B, n, T, M, 3]` it
    would take the three coordinates of one object; in this layout it takes sixteen plans.
    """
    for node in _calls(graph, aten.cat.default):
        parts, *_ = _arguments(node)
        dimension, count = _dimension(node), _value(node).ndim
        if 2 <= dimension < count - 1 and _value(node).shape[-1] <= FEW:
            order = [*range(2, count), 0, 1]
            back = [order.index(number) for number in range(count)]
            with _before(node) as tensor:
                joined: Any = torch.cat([tensor(part).permute(order) for part in parts], order.index(dimension))
                _replace(node, joined.permute(back))


def write_transposed_copies(graph: Graph) -> None:
    """Write a copy that changes the order of dimensions in memory, once.

    Inductor computes a copy where it is read. Every reader would then follow the strides of the original, which leaves
    loops over three objects instead of sixteen plans at a time.
    """
    for node in _calls(graph, aten.contiguous.default):
        original, *_ = _arguments(node)
        if len(_value(original)) > 1 and _is_transposed(_value(original)):
            with _before(node) as tensor:
                value = tensor(original)
                _replace(node, torch.cat([value[:1], value[1:]]))


PASSES: Sequence[Callable[[Graph], None]] = (
    drop_checks,
    expand_small_layers,
    split_concatenated_inputs,
    round_concatenated,
    invert_shared_divisors,
    move_plans_innermost,
    write_transposed_copies,
)


def _calls(graph: Graph, operator: Any) -> Sequence[Node]:
    """All current calls of an operator in the graph."""
    return tuple(graph.find_nodes(op="call_function", target=operator))


def _arguments(node: Node) -> Sequence[Any]:
    return node.args


def _value(node: Any) -> Tensor:
    """Shape and type of a node's result."""
    return node.meta["val"]


@contextmanager
def _before(node: Node) -> Iterator[Callable[[Node], Any]]:
    """Yield proxies of nodes; operations on them are inserted into the graph before `node`."""
    tracer = GraphAppendingTracer(node.graph)
    with node.graph.inserting_before(node):
        yield lambda other: Proxy(other, tracer)


def _is_transposed(value: Tensor) -> bool:
    """Whether dimensions lie in another order in memory."""
    strides = [stride for size, stride in zip(value.shape, value.stride(), strict=True) if size > 1 and stride > 0]
    return strides != sorted(strides, reverse=True)


def _joined(node: Node) -> Sequence[Any]:
    """The inputs of a concatenation along the last dimension; none for other nodes."""
    last = node.target is aten.cat.default and _dimension(node) == _value(node).ndim - 1
    return _arguments(node)[0] if last else ()


def _dimension(cat: Node) -> int:
    """The dimension of a `torch.cat`, counted from the first."""
    _, *dimension = _arguments(cat)
    return int(*dimension) % _value(cat).ndim


def _written(inputs: Any) -> Any:
    """The same values, written to memory: Inductor materialises concatenations."""
    return torch.cat([inputs[..., :1], inputs[..., 1:]], -1)


def _products(inputs: Any, weight: Any, count: int) -> list[Any]:
    """Each of the `count` inputs `[..., count]` times its weights, which are a column of `weight: [outputs, count]`."""
    columns = weight.t().contiguous()  # adjacent in memory
    return [inputs[..., number : number + 1] * columns[number] for number in range(count)]


def _replace(node: Node, by: Any) -> None:
    node.replace_all_uses_with(by.node)
    node.graph.erase_node(node)
