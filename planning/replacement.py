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
