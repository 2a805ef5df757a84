"""Samples of a model's priors, with one generator per environment.

Numbers are sampled on the generator's device and go to the device of the plan. With generators of the CPU, plans of one
seed search the same noise on every device.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.distributions import Distribution, Independent, Normal, TransformedDistribution

from cavin_pyro.models.state import State
from cavin_pyro.planning.protocol import Reparameterized


def sample_codes(
    prior: Callable[..., Distribution],
    conditions: Sequence[State | Tensor],
    noise: Tensor | None,
    generators: Sequence[torch.Generator] = (),
) -> Tensor:
    """Codes `[B, N, D]` of `prior(*conditions)`: reparameterised from `noise: [B, N, D]`, or sampled without noise.

    `conditions`: the arguments of the prior, states and codes with leading dimensions `[B, N]`. The prior is called
    once per environment, each with its own generator, so its codes do not depend on the rest of the batch. Raises
    ValueError for a prior that cannot be written as a function of noise.
    """
    codes = []
    for index, source in enumerate(generators if noise is None else noise):
        here = prior(*(one.scene(index) if isinstance(one, State) else one[index] for one in conditions))
        if isinstance(source, Tensor):
            codes.append(reparameterize(here, source))
        else:
            first = conditions[0]
            device = (first.centers if isinstance(first, State) else first).device
            codes.append(sample(here, source, device))
    return torch.stack(codes)


def noise_each(
    shape: Sequence[int], generators: Sequence[torch.Generator], device: torch.device | None = None
) -> Tensor:
    """Standard normal noise, each environment's from its own generator: `[B, *shape]`.

    device: where it goes, by default that of the generators.
    """
    samples = [torch.randn(*shape, generator=source, device=source.device) for source in generators]
    return torch.stack(samples).to(device or samples[0].device)


def uniform_each(
    shape: Sequence[int], generators: Sequence[torch.Generator], device: torch.device | None = None
) -> Tensor:
    """Uniform numbers in [0, 1), each environment's from its own generator: `[B, *shape]`; `device` as above."""
    samples = [torch.rand(*shape, generator=source, device=source.device) for source in generators]
    return torch.stack(samples).to(device or samples[0].device)


def reparameterize(prior: Distribution, noise: Tensor) -> Tensor:
    """The code `[..., D]` that standard normal `noise: [..., D]` determines: mean + scale * noise, or a flow's.

    Raises ValueError for a distribution that is neither normal, nor a transformed normal, nor `Reparameterized`.
    """
    if isinstance(prior, Reparameterized):
        return prior.reparameterize(noise)
    if isinstance(prior, Independent):
        return reparameterize(prior.base_dist, noise)
    if isinstance(prior, Normal):
        return prior.loc + prior.scale * noise
    if isinstance(prior, TransformedDistribution):
        code = reparameterize(prior.base_dist, noise)
        for transform in prior.transforms:
            code = transform(code)
        return code
    raise ValueError(
        f"codes of a prior of type {type(prior).__name__} can be sampled, but not reparameterized: it is neither "
        "normal nor a transformed normal, and has no method reparameterize; choose the optimizer shooting and "
        "early_stopping=false"
    )


def _is_reparameterizable(prior: Distribution) -> bool:
    """Whether `reparameterize` supports this prior."""
    if isinstance(prior, Reparameterized):
        return True
    if isinstance(prior, Independent | TransformedDistribution):
        return _is_reparameterizable(prior.base_dist)
    return isinstance(prior, Normal)


def sample(prior: Distribution, generator: torch.Generator, device: torch.device) -> Tensor:
    """One sample `[..., D]` for every element of the batch, from this generator alone; `device`: of the prior."""
    if _is_reparameterizable(prior):
        shape = prior.batch_shape + prior.event_shape
        return reparameterize(prior, torch.randn(shape, generator=generator, device=generator.device).to(device))
    with _global_randomness_from(generator, device):
        return prior.sample()


@contextmanager
def _global_randomness_from(generator: torch.Generator, device: torch.device) -> Iterator[None]:
    """Use a generator as torch's global one on a device: `Distribution.sample` takes no generator.

    A generator of the CPU seeds the global one of another device, whose algorithm differs: the samples are the same in
    every run there, and others than on the CPU.
    """
    if device.type == "cpu":
        with torch.random.fork_rng(devices=[]):
            torch.set_rng_state(generator.get_state())
            yield
            generator.set_state(torch.get_rng_state())
        return
    place = torch.get_device_module(device)
    with torch.random.fork_rng(devices=[device], device_type=device.type):
        if generator.device.type == "cpu":
            place.manual_seed(int(torch.randint(2**62, (), generator=generator)))
            yield
        else:
            place.set_rng_state(generator.get_state(), device)
            yield
            generator.set_state(place.get_rng_state(device))
