"""What is rewritten in exported graphs, so that torch's Inductor makes fast code of them.

Models, priors, rewards and planners have one body each, written as in the paper and run as it stands by the eager
backend. What only native code needs is done here, to the graph that `torch.export` makes of that body. Every pass takes
a graph and changes it in place; results stay the same but for the rounding of sums. Inductor does the rest by option
(`planning.backends.compiled.COMPILING`): for example, it unrolls the minima over a layout's rectangles.
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

FEW = 4  # numbers that are added up one by one: x, y and z, or a push
EXACT = 64  # dividing as many numbers costs nothing, and stays exact


def rewrite(module: GraphModule) -> None:
    """Apply all passes to a graph, and to the graphs within it (`torch.autocast` makes one of all that it rounds)."""
    for part in module.modules():
        if isinstance(part, GraphModule):
            for change in PASSES:
                change(part.graph)
            part.recompile()


def drop_checks(graph: Graph) -> None:
    """Leave out what export adds to see that types stay: `expand_small_layers` changes some on purpose."""
    for node in _calls(graph, aten._assert_tensor_metadata.default):
        graph.erase_node(node)


def expand_small_layers(graph: Graph) -> None:
    """A linear layer of few inputs becomes a sum of products, in float32 also where products are rounded.

    Calling a matrix product costs 30 microseconds, however small it is. Numbers that are added up one by one cost
    little more than writing the result, if each is read from memory (hence the copy) and not computed for each output.
    """
    for node in _calls(graph, aten.linear.default):
        inputs, weight, *bias = _arguments(node)
        count = _value(weight).shape[-1]
        if count <= FEW:
            with _before(node) as tensor:
                products = _products(_written(tensor(inputs)), tensor(weight), count)
                _replace(node, reduce(add, [*map(tensor, bias), *products]))


def split_joined_inputs(graph: Graph) -> None:
    """A linear layer of few and of many joined numbers becomes a layer of the many, plus the few times their weights.

    The inputs are then not joined, and the share of the few is added where the sum is read anyway. The first layer of a
    learned prior reads a position and 64 features.
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


def round_joined(graph: Graph) -> None:
    """What was joined in bfloat16 is rounded before: `expand_small_layers` leaves float32, twice as much to write."""
    for node in _calls(graph, aten.cat.default):
        if _value(node).dtype == torch.bfloat16:
            parts, *dimension = _arguments(node)
            with _before(node) as tensor:
                _replace(node, torch.cat([tensor(part).to(torch.bfloat16) for part in parts], *dimension))


def invert_shared_divisors(graph: Graph) -> None:
    """A division by what several numbers share becomes a product with its reciprocal.

    A division takes several times as long as a product. 64 features are divided by one length, positions by a unit.
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


def lay_plans_side_by_side(graph: Graph) -> None:
    """What is joined along time is written so that all plans' first numbers come first, then all plans' second ones.

    Native code computes sixteen numbers at a time where they lie side by side in memory. Of paths `[B, n, T, M, 3]` it
    would take the three coordinates of one object; of paths so laid out it takes sixteen plans.
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


PASSES: Sequence[Callable[[Graph], None]] = (
    drop_checks,
    expand_small_layers,
    split_joined_inputs,
    round_joined,
    invert_shared_divisors,
    lay_plans_side_by_side,
)


def _calls(graph: Graph, operator: Any) -> Sequence[Node]:
    """All calls of an operator that are in the graph by now."""
    return tuple(graph.find_nodes(op="call_function", target=operator))


def _arguments(node: Node) -> Sequence[Any]:
    return node.args


def _value(node: Any) -> Tensor:
    """Shape and type of what a node stands for."""
    return node.meta["val"]


@contextmanager
def _before(node: Node) -> Iterator[Callable[[Node], Any]]:
    """What is computed with the results of nodes becomes part of the graph, before `node`."""
    tracer = GraphAppendingTracer(node.graph)
    with node.graph.inserting_before(node):
        yield lambda other: Proxy(other, tracer)


def _joined(node: Node) -> Sequence[Any]:
    """What a node joins along the last dimension; nothing if it does something else."""
    last = node.target is aten.cat.default and _dimension(node) == _value(node).ndim - 1
    return _arguments(node)[0] if last else ()


def _dimension(cat: Node) -> int:
    """Along which `torch.cat` joins, counted from the first."""
    _, *dimension = _arguments(cat)
    return int(*dimension) % _value(cat).ndim


def _written(inputs: Any) -> Any:
    """The same, which Inductor then writes to memory: it does so with what is joined."""
    return torch.cat([inputs[..., :1], inputs[..., 1:]], -1)


def _products(inputs: Any, weight: Any, count: int) -> list[Any]:
    """Each of the `count` inputs `[..., count]` times its weights, which are a column of `weight: [outputs, count]`."""
    columns = weight.t().contiguous()  # side by side in memory
    return [inputs[..., number : number + 1] * columns[number] for number in range(count)]


def _replace(node: Node, by: Any) -> None:
    node.replace_all_uses_with(by.node)
    node.graph.erase_node(node)
