"""Copies of active candidates replace failed ones.

Section 3.2 of the paper: "episodes which fail early will be replaced by duplicating episodes that are still
active".
"""

from __future__ import annotations

import torch
from torch import Tensor


def choose_ancestors(failed: Tensor, active: Tensor, uniforms: Tensor) -> Tensor:
    """The ancestor of every candidate, the index of the candidate that it continues: `[B, N]` int64.

    `failed`, `active`: `[B, N]` bool. `uniforms`: `[B, N]`, uniform in [0, 1). A failed candidate continues an active
    one, all equally likely; every other candidate continues itself, successful ones too. An environment without an
    active candidate keeps all of its candidates.
    """
    own = torch.arange(failed.shape[-1], device=failed.device).expand_as(failed)
    actives = active.cumsum(-1)  # counts active candidates up to and including each
    count = actives[:, -1:]
    rank = (uniforms * count).long().clamp(max=(count - 1).clamp(min=0))  # a product may be rounded up to its factor
    ancestors = torch.searchsorted(actives, rank + 1).clamp(max=failed.shape[-1] - 1)
    return torch.where(failed & (count > 0), ancestors, own)
