"""One segment more of plans under way: a pure function, which an engine may compile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning import fields
from planning.replacement import choose_parents
from planning.segments import Level, Score, Stretch


class Extension(NamedTuple):
    """Plans one segment on."""

    stretch: Stretch
    standing: Any  # after it
    parents: Tensor | None  # [B, n] int64, where copies take the place of the dead
    plans: State  # [B, n] and then
    onward: Any  # their standing
    settled: Tensor | None  # [B] bool, see `planning.candidates.Search.evaluate`


def extended(
    level: Level,
    score: Score,
    number: int,
    here: State,
    before: State,
    standing: Any,
    noise: Tensor | None,
    chances: Tensor | None,
    settled: Tensor | None,
    generators: Sequence[torch.Generator] = (),
) -> Extension:
    """Segment `number` of plans that have come to `before: [B, n]`.

    For `chances` and `settled` see `planning.candidates.Candidates.step`, for `here` see `Level.extend`. The
    `generators` are read where there is no noise.
    """
    compiling = torch.compiler.is_compiling()  # compiled code has no branches
    stretch = level.extend(number, here, before, noise, generators)
    going = standing.active
    stopped = settled if settled is not None and (compiling or bool(settled.any())) else None
    if stopped is not None:
        going = going & ~stopped.unsqueeze(-1)
        nothing = fields.apply((stretch.code, stretch.actions), torch.zeros_like)
        code, actions = fields.where(stopped, nothing, (stretch.code, stretch.actions))
        stretch = stretch._replace(code=code, actions=actions)
    stretch = _stay(stretch, before, going)
    after = score.advance(standing, number, before, stretch)
    if stopped is not None:
        after = fields.where(stopped, standing, after)
    if settled is not None:
        settled = score.settled(after)
    if chances is None:
        return Extension(stretch, after, None, stretch.states, after, settled)
    dead = after.failed if stopped is None else after.failed & ~stopped.unsqueeze(-1)
    if not compiling and not bool(dead.any()):
        return Extension(stretch, after, None, stretch.states, after, settled)
    parents = choose_parents(dead, after.active, chances)
    return Extension(stretch, after, parents, *fields.take((stretch.states, after), parents), settled)


def _stay(stretch: Stretch, before: State, active: Tensor) -> Stretch:
    """Keep plans where they are that have ended: not `active: [B, n]`; no copy where all go on."""
    if not torch.compiler.is_compiling() and bool(active.all()):
        return stretch
    going = active[..., None, None]
    states = State(
        torch.where(going, stretch.states.centers, before.centers),
        torch.where(going, stretch.states.features, before.features),
        stretch.states.mask,
    )
    path = torch.where(going.unsqueeze(-1), stretch.path, before.centers.unsqueeze(-3))
    return stretch._replace(states=states, path=path)
