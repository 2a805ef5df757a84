"""What is left of the last plan, for optimisers that go on from it."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from planning.candidates import Candidates
from planning.plan import Plan
from planning.sampling import noise_each


def remembered(chosen: Candidates) -> Tensor:
    """The noise `[B, K, D]` that the chosen plans `[B, 1]` were made of; K = 0 where they were not made of noise."""
    if any(segment.noise is None for segment in chosen.kept):
        return chosen.plans.centers.new_empty(len(chosen.plans.mask), 0, 0)
    return chosen.noise[:, 0]


def hints(previous: Plan | None, generators: Sequence[torch.Generator]) -> Tensor | None:
    """What may be left of the last plan, some or all of whose first segment was executed: `[B, 1 + K, K, D]`, or None.

    First the plan as it was, for whoever has made one push of many. Then the plan without its first segment, without
    its second, and so on, each with one fresh segment at the end: what a plan that succeeds does not need, it loses
    in this way, one segment at a time.
    """
    if previous is None or previous.noise.shape[1] == 0:
        return None
    segments = previous.noise.shape[1]
    fresh = noise_each((1, previous.noise.shape[-1]), generators)
    longer = torch.cat([previous.noise, fresh], 1)  # of these K + 1 segments one is left out, the fresh one first
    return torch.stack(
        [torch.cat([longer[:, :out], longer[:, out + 1 :]], 1) for out in (segments, *range(segments))], 1
    )
