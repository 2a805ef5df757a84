"""A guide refined for each window on its own, to measure the amortization gap."""

from __future__ import annotations

from typing import Any

import torch
from pyro import distributions, poutine
from pyro.distributions import transforms
from pyro.infer.reparam.reparam import Reparam, ReparamResult
from torch import Tensor

from cavin_pyro.criticism.statistics.codes import sample_guide
from cavin_pyro.training.elbo import Program, window_terms
from models.state import Window

SAMPLES_FOR_SPREAD = 64


class WindowwiseAffine(Reparam):
    """Moves and stretches a code of each window: x -> center + exp(stretch) (x - center) + spread * shift.

    `center`, `spread`, `shift`, `stretch`: `[B, D]`. With shift and stretch zero it changes nothing. For a Gaussian
    q(c | window) this is the family of all diagonal Gaussians; of any other guide it moves the whole shape, and of
    q(z | c, window) it keeps how z depends on c.
    """

    def __init__(self, samples: Tensor) -> None:
        """`samples: [N, B, D]` of the guide, for the location and scale of each window's code."""
        self.center, self.spread = samples.mean(0), samples.std(0)
        self.shift = torch.zeros_like(self.center, requires_grad=True)
        self.stretch = torch.zeros_like(self.center, requires_grad=True)

    def apply(self, msg: Any) -> ReparamResult:
        stretch = self.stretch.exp()
        location = self.center * (1 - stretch) + self.spread * self.shift
        moved = transforms.AffineTransform(location, stretch, event_dim=1)
        fn = distributions.TransformedDistribution(msg["fn"], [moved])
        return {"fn": fn, "value": msg["value"], "is_observed": msg["is_observed"]}


def refine(
    model: Program,
    guide: Program,
    window: Window,
    *,
    steps: int = 400,
    particles: int = 16,
    learning_rate: float = 0.2,
) -> Program:
    """The guide with the best shift and stretch for each window `[B]`, by Adam on the same ELBO.

    The rate falls linearly to zero, so a shift reaches about steps * learning_rate / 2 deviations of the guide. Windows
    do not share anything, so they are refined side by side. Neither the model nor the guide is changed.

    Returns:
        A guide for this same `window` and no other.
    """
    samples = sample_guide(guide, window, SAMPLES_FOR_SPREAD)
    affine = {name: WindowwiseAffine(value) for name, value in samples.items()}
    config: dict[str, Reparam] = {**affine}
    refined = poutine.reparam(guide, config=config)
    free = [tensor for code in affine.values() for tensor in (code.shift, code.stretch)]
    optimizer = torch.optim.Adam(free, lr=learning_rate)
    schedule = torch.optim.lr_scheduler.LinearLR(optimizer, 1.0, 0.0, total_iters=steps)
    for _ in range(steps):
        optimizer.zero_grad()
        terms = window_terms(model, refined, window, particles=particles)
        torch.stack(list(terms.values())).mean(1).sum().backward(inputs=free)
        optimizer.step()
        schedule.step()
    return refined
