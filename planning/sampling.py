"""Drawing from a model's priors with one source of randomness per environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.distributions import Distribution

from models.state import State


def sample_each(
    prior: Callable[..., Distribution],
    conditions: Sequence[State | Tensor],
    generators: Sequence[torch.Generator],
) -> Tensor:
    """One draw per plan from `prior(*conditions)`, each environment with its own generator: `[B, N, 16]`.

    `conditions`: what the prior is given, states and codes with leading dimensions `[B, N]`. The prior is
    asked per environment, so that neither its randomness nor its distribution sees the rest of the batch.
    """
    draws = []
    for index, generator in enumerate(generators):
        scene = [_scene(condition, index) for condition in conditions]
        distribution = prior(*scene)
        with _global_randomness_from(generator):
            draws.append(distribution.sample())
    return torch.stack(draws)


def _scene(condition: State | Tensor, index: int) -> State | Tensor:
    return condition.scene(index) if isinstance(condition, State) else condition[index]


@contextmanager
def _global_randomness_from(generator: torch.Generator) -> Iterator[None]:
    """Let a generator stand in for torch's global one: distributions take no generator of their own."""
    device = generator.device
    if device.type == "cuda":
        with torch.random.fork_rng(devices=[device]):
            torch.cuda.set_rng_state(generator.get_state(), device)
            yield
            generator.set_state(torch.cuda.get_rng_state(device))
    else:
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(generator.get_state())
            yield
            generator.set_state(torch.get_rng_state())
