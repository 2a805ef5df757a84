"""Copies of living plans in the place of dead ones.

Section 3.2 of the paper: "episodes which fail early will be replaced by duplicating episodes that are still
active".
"""

from __future__ import annotations

import torch
from torch import Tensor


def choose_parents(failed: Tensor, active: Tensor, chances: Tensor) -> Tensor:
    """For every plan, the number of the plan that it goes on from: `[B, N]` int64.

    `failed`, `active`: `[B, N]` bool. `chances`: `[B, N]`, uniform in [0, 1). A failed plan goes on from an active one,
    all equally likely; every other plan from itself, successful ones too. An environment with no active plan keeps all
    of its plans.
    """
    own = torch.arange(failed.shape[-1], device=failed.device).expand_as(failed)
    living = active.cumsum(-1)  # of the first plans, up to and including each
    number = living[:, -1:]
    rank = (chances * number).long().clamp(max=(number - 1).clamp(min=0))  # a product may be rounded up to its factor
    parents = torch.searchsorted(living, rank + 1).clamp(max=failed.shape[-1] - 1)
    return torch.where(failed & (number > 0), parents, own)
