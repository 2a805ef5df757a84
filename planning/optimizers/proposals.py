"""Proposal distributions of noise and values of states, which steer sequential Monte Carlo to good plans.

Neither changes the estimated quantity. The weights divide out both: each segment's by prior / proposal, and a value by
the value of the next segment. A bad proposal or value only costs effective samples.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import torch
from torch import Tensor
from torch.distributions import Categorical, Distribution, Independent, MixtureSameFamily, Normal

from models.state import State
from planning.inputs import OptimizerError, check_fraction
from planning.rollouts.candidates import Candidates
from planning.rollouts.sampling import noise_each, sample


@runtime_checkable
class NoiseProposal(Protocol):
    """A distribution of the next segment's noise, in place of the prior N(0, I): a guide for plans.

    It returns a distribution, and the optimizer computes the weight from its density. So the weights are correct for
    any proposal whose density is positive everywhere.
    """

    def __call__(self, segment: int, plans: State, noise: Tensor, warm_start: Tensor | None) -> Distribution | None:
        """For n plans of one environment: batch `[n]`, event `[D]`; None for the prior.

        segment: number of the next one, from 0. plans: their states `[n]`. noise: `[n, segment, D]`, of the segments so
        far. warm_start: `[h, K, D]`, noise of promising plans, or None; see `SearchProblem`.
        """


class Value(Protocol):
    """An estimate of a plan's later return, in units of return: a twisting function, learned or heuristic.

    The optimum is `temperature * log E[exp(later return / temperature)]`.
    """

    def __call__(self, segment: int, plans: State) -> Tensor:
        """Finite values `[B, n]` of `plans: [B, n]`, which have `segment` segments. Ended plans do not count."""


@dataclass(frozen=True)
class LastPlan:
    """Plans like the last one: a mixture of the prior and of normal distributions around the warm start's plans.

    Each plan follows the prior or one plan of the warm start in all its segments; without a warm start, the prior.
    Around a plan's noise x, the density is N(correlation x, 1 - correlation^2), which has the prior's variance on
    average.

    prior_fraction: of plans that follow the prior. Without resampling and moves, prior / proposal of a whole plan is at
        most its inverse.
    correlation: 0 follows the prior only, and near 1 plans stay near the last one.

    Raises ValueError for a `prior_fraction` outside of (0, 1] and a `correlation` outside of [0, 1).
    """

    prior_fraction: float = 0.5
    correlation: float = 0.7

    def __post_init__(self) -> None:
        check_fraction("prior_fraction", self.prior_fraction, positive=True)
        if not 0 <= self.correlation < 1:
            raise ValueError(f"correlation must be at least 0 and below 1, not {self.correlation}")

    def __call__(self, segment: int, plans: State, noise: Tensor, warm_start: Tensor | None) -> Distribution | None:
        """See `NoiseProposal`."""
        if warm_start is None:
            return None
        count, known = noise.shape[0], warm_start.shape[0]
        centers = self.correlation * torch.cat([torch.zeros_like(warm_start[:1]), warm_start])  # [1 + h, K, D]
        scales = torch.full_like(centers, math.sqrt(1.0 - self.correlation**2))
        scales[0] = 1.0
        shares = centers.new_full((1 + known,), (1.0 - self.prior_fraction) / known)
        shares[0] = self.prior_fraction
        # The plan that a candidate follows is not remembered but inferred from its noise: the density of a mixture
        # of whole plans, segment by segment.
        before = Normal(centers[:, :segment], scales[:, :segment]).log_prob(noise.unsqueeze(1)).sum((-2, -1))
        components = Independent(Normal(centers[:, segment], scales[:, segment]), 1).expand((count, 1 + known))
        return MixtureSameFamily(Categorical(logits=shares.log() + before), components)


PROPOSALS: dict[str, NoiseProposal | None] = {"prior": None, "last_plan": LastPlan()}


def propose(proposal: NoiseProposal | None, candidates: Candidates) -> tuple[Tensor, Tensor]:
    """Noise `[B, n, D]` of the next segment, and the logarithm of prior / proposal at it, `[B, n]` float64.

    Ended candidates take the prior's noise, since theirs no longer matters.
    """
    problem, segment = candidates.problem, len(candidates.segments)
    prior = noise_each((candidates.count, problem.dimension), problem.generators, problem.device)
    ratios = torch.zeros_like(candidates.returns, dtype=torch.float64)
    if proposal is None:
        return prior, ratios
    noise = prior.clone()
    before = candidates.noise if segment else prior.new_empty(*prior.shape[:2], 0, prior.shape[-1])
    for index, generator in enumerate(problem.generators):
        known = None if problem.warm_start is None else problem.warm_start[index]
        distribution = proposal(segment, candidates.plans.scene(index), before[index], known)
        if distribution is None:
            continue
        if (distribution.batch_shape, distribution.event_shape) != (prior.shape[1:2], prior.shape[2:]):
            raise OptimizerError(
                f"{type(proposal).__name__} must give a distribution of batch [n] = {list(prior.shape[1:2])} and event "
                f"[D] = {list(prior.shape[2:])}, not {list(distribution.batch_shape)} and "
                f"{list(distribution.event_shape)}"
            )
        active = candidates.score_state.active[index]
        noise[index] = torch.where(active.unsqueeze(-1), sample(distribution, generator, problem.device), prior[index])
        ratio = standard_normal(noise[index]) - distribution.log_prob(noise[index]).double()
        ratios[index] = torch.where(active, ratio, 0.0)
    return noise, ratios


def standard_normal(noise: Tensor) -> Tensor:
    """The logarithm of the density of N(0, I): `[..., D] -> [...]` float64."""
    return Normal(0.0, 1.0).log_prob(noise.double()).sum(-1)
