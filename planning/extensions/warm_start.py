"""The last plan's noise among the candidates (our addition to Algorithm 1, line 5)."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from planning.plan import Plan
from planning.rollouts.candidates import Candidates
from planning.rollouts.sampling import noise_each


def chosen_noise(chosen: Candidates) -> Tensor:
    """The noise `[B, K, D]` of the chosen candidates `[B, 1]`; K = 0 for candidates not made from noise."""
    if any(segment.noise is None for segment in chosen.segments):
        return chosen.plans.centers.new_empty(len(chosen.plans.mask), 0, 0)
    return chosen.noise[:, 0]


def warm_start_noise(previous: Plan | None, generators: Sequence[torch.Generator]) -> Tensor | None:
    """Candidates from the last plan, some or all of whose first segment was executed: `[B, 1 + K, K, D]`, or None.

    First the plan as it was, for callers that execute one push of many. Then the plan without its first segment,
    without its second, and so on, each with one fresh segment at the end: so a plan that succeeds loses the segments
    that it does not need, one at a time.
    """
    if previous is None or previous.noise.shape[1] == 0:
        return None
    segments = previous.noise.shape[1]
    fresh = noise_each((1, previous.noise.shape[-1]), generators)
    longer = torch.cat([previous.noise, fresh], 1)  # of these K + 1 segments one is left out, the fresh one first
    return torch.stack(
        [torch.cat([longer[:, :out], longer[:, out + 1 :]], 1) for out in (segments, *range(segments))], 1
    )
