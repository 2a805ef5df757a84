"""What is left of the last plan, for optimisers that go on from it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from planning.candidates import Candidates
from planning.plan import Plan
from planning.sampling import noise_each


def remembered(candidates: Candidates, chosen: Tensor) -> Tensor:
    """The noise `[B, K, D]` that plans number `chosen: [B]` were made of; K = 0 where they were not made of noise."""
    if any(segment.noise is None for segment in candidates.kept):
        return candidates.plans.centers.new_empty(len(chosen), 0, 0)
    return candidates.take(chosen.unsqueeze(-1)).noise[:, 0]


def hints(previous: Plan | None, generators: Sequence[torch.Generator]) -> Tensor | None:
    """What is left of a plan whose first segment has been executed, with a fresh last one: `[B, 1, K, D]`, or None."""
    if previous is None or previous.noise.shape[1] == 0:
        return None
    noise = previous.noise
    fresh = noise_each((1, noise.shape[-1]), generators)
    return torch.cat([noise[:, 1:], fresh], 1).unsqueeze(1)
