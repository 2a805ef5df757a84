"""Drawing from a model's priors with one source of randomness per environment."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, TransformedDistribution

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
    return torch.stack(
        [
            _draw(prior(*(_scene(condition, index) for condition in conditions)), generator)
            for index, generator in enumerate(generators)
        ]
    )


def noise_each(shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
    """Standard normal noise, each environment's from its own generator: `[B, *shape]`."""
    return torch.stack([torch.randn(*shape, generator=source, device=source.device) for source in generators])


def uniform_each(shape: Sequence[int], generators: Sequence[torch.Generator]) -> Tensor:
    """Uniform numbers in [0, 1), each environment's from its own generator: `[B, *shape]`."""
    return torch.stack([torch.rand(*shape, generator=source, device=source.device) for source in generators])


def codes_each(prior: Callable[..., Distribution], conditions: Sequence[State | Tensor], noise: Tensor) -> Tensor:
    """The codes that standard normal `noise: [B, N, D]` stands for: `[B, N, D]`, distributed as the prior.

    Asked per environment, as in `sample_each`. Raises ValueError for a prior that cannot be written as a
    function of such noise.
    """
    return torch.stack(
        [
            code_of(prior(*(_scene(condition, index) for condition in conditions)), own)
            for index, own in enumerate(noise)
        ]
    )


def code_of(prior: Distribution, noise: Tensor) -> Tensor:
    """The code that standard normal noise stands for: mean + scale * noise, or through a flow's transforms.

    `noise: [..., D]` -> `[..., D]`. Distributions that are none of torch's say it themselves, by a method
    `from_noise`. Raises ValueError for any other.
    """
    if hasattr(prior, "from_noise"):
        return prior.from_noise(noise)
    if isinstance(prior, Independent):
        return code_of(prior.base_dist, noise)
    if isinstance(prior, Normal):
        return prior.loc + prior.scale * noise
    if isinstance(prior, TransformedDistribution):
        code = code_of(prior.base_dist, noise)
        for transform in prior.transforms:
            code = transform(code)
        return code
    raise ValueError(
        f"codes of a prior of type {type(prior).__name__} can be drawn, but neither searched nor remembered: it is "
        "neither normal nor a transformed normal, and has no method from_noise; take the optimizer shooting, and "
        "memory=false"
    )


def _is_made_of_noise(prior: Distribution) -> bool:
    """Whether `code_of` knows this prior."""
    if isinstance(prior, Independent | TransformedDistribution) and not hasattr(prior, "from_noise"):
        return _is_made_of_noise(prior.base_dist)
    return isinstance(prior, Normal) or hasattr(prior, "from_noise")


def _draw(prior: Distribution, generator: torch.Generator) -> Tensor:
    if _is_made_of_noise(prior):
        shape = prior.batch_shape + prior.event_shape
        return code_of(prior, torch.randn(shape, generator=generator, device=generator.device))
    with _global_randomness_from(generator):
        return prior.sample()


def _scene(condition: State | Tensor, index: int) -> State | Tensor:
    return condition.scene(index) if isinstance(condition, State) else condition[index]


@contextmanager
def _global_randomness_from(generator: torch.Generator) -> Iterator[None]:
    """Let a generator stand in for torch's global one: `Distribution.sample` takes no generator of its own."""
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
