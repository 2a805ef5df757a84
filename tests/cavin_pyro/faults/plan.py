"""Which faults are tried, in which order: a seed decides, and every command has its share of any part of them."""

from __future__ import annotations

import random
from collections.abc import Iterator, Mapping, Sequence

from tests.cavin_pyro.faults.shim import KINDS, Call, Fault, kinds_of

Plan = tuple[str, tuple[Fault, ...]]  # the name of a subject, and the faults of its runs


def plans(calls: Mapping[str, Sequence[Call]], seed: int, first: int = 0) -> Iterator[Plan]:
    """Every kind of fault at every call of every command, in a random order; then runs with two faults, without end.

    Args:
        calls: of each command, in a run without a fault. first: leave out so many.
    """
    numbered = _in_turn(calls, seed)
    for _ in range(first):
        next(numbered)
    yield from numbered


def singles(calls: Mapping[str, Sequence[Call]]) -> int:
    """How many plans have one fault."""
    return sum(len(kinds_of(call)) for own in calls.values() for call in own)


def _in_turn(calls: Mapping[str, Sequence[Call]], seed: int) -> Iterator[Plan]:
    generator = random.Random(seed)
    queues = {name: [Fault(call, kind) for call in own for kind in kinds_of(call)] for name, own in calls.items()}
    for queue in queues.values():
        generator.shuffle(queue)
    every = {name: list(queue) for name, queue in queues.items()}
    while any(queues.values()):
        for name, queue in queues.items():
            if queue:
                yield name, (queue.pop(),)
    while True:
        for name, own in every.items():
            # The second run makes other calls than the first: any of them, by its number alone.
            call = Call("any", "*", generator.randint(1, len(calls[name])))
            yield name, (generator.choice(own), Fault(call, generator.choice(KINDS)))
