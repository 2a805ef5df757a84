"""The last plan's noise among the candidates (our addition to Algorithm 1, line 5)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from planning.plan import Plan
from planning.rollouts.candidates import Candidates
from planning.rollouts.sampling import noise_each


def chosen_noise(chosen: Candidates) -> Tensor:
    """The noise `[B, K, D]` of the chosen candidates `[B, 1]`; K = 0 for candidates that were not reparameterised."""
    if any(segment.noise is None for segment in chosen.segments):
        return chosen.plans.centers.new_empty(len(chosen.plans.mask), 0, 0)
    return chosen.noise[:, 0]


def warm_start_noise(previous: Plan | None, generators: Sequence[torch.Generator]) -> Tensor | None:
    """Candidates from the last plan, after a part of its first segment was executed: `[B, 1 + K, K, D]`, or None.

    The first candidate is the unchanged plan, for callers that execute one push of many. The others are the plan
    without its first segment, without its second, and so on, each with one fresh segment at the end. So a successful
    plan loses the segments that it does not need, one at a time.
    """
    if previous is None or previous.noise.shape[1] == 0:
        return None
    segments = previous.noise.shape[1]
    fresh = noise_each((1, previous.noise.shape[-1]), generators, previous.noise.device)
    # Each candidate omits one of these K + 1 segments, the first candidate the fresh one.
    longer = torch.cat([previous.noise, fresh], 1)
    return torch.stack(
        [torch.cat([longer[:, :out], longer[:, out + 1 :]], 1) for out in (segments, *range(segments))], 1
    )
