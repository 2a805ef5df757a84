"""Copies of living plans in the place of dead ones.

Section 3.2 of the paper: "episodes which fail early will be replaced by duplicating episodes that are still
active".
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor


def draw_parents(failed: Tensor, active: Tensor, generators: Sequence[torch.Generator]) -> Tensor:
    """For every plan, the number of the plan that it goes on from: `[B, N]` int64.

    `failed`, `active`: `[B, N]` bool. A failed plan goes on from an active one, drawn uniformly with its
    environment's generator; every other plan from itself, successful ones too. An environment with no active
    plan keeps all of its plans. A generator is used only where its environment replaces something.
    """
    environments, plans = failed.shape
    parents = torch.arange(plans, device=failed.device).repeat(environments, 1)
    for index in (failed.any(-1) & active.any(-1)).nonzero().flatten().tolist():
        living = active[index].nonzero().squeeze(-1)
        dead = failed[index].nonzero().squeeze(-1)
        choice = torch.randint(len(living), (len(dead),), generator=generators[index], device=failed.device)
        parents[index, dead] = living[choice]
    return parents


def trace_back(parents: Tensor) -> Tensor:
    """For every final plan, the number that it had in each segment: `[K, B, N]` int64.

    `parents: [K, B, N]`, of which `parents[k]` says what the plans go on from after segment k (the last of
    them: what the final plans are). What segment k has recorded under number `trace_back(parents)[k, b, n]`
    belongs to the final plan n.
    """
    numbers = [parents[-1]]
    for earlier in reversed(parents[:-1].unbind()):
        numbers.append(earlier.gather(-1, numbers[-1]))
    return torch.stack(numbers[::-1])
