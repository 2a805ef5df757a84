"""One more segment of candidates: a pure function, which a backend may compile."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import torch
from torch import Tensor

from models.state import State
from planning import records
from planning.rollouts.replacement import choose_ancestors
from planning.rollouts.segment import Objective, SearchSpace, SegmentRollout


class ExtendedSegment(NamedTuple):
    """Candidates after one more segment."""

    rollout: SegmentRollout
    score_state: Any  # after the segment
    ancestors: Tensor | None  # [B, n] int64, if copies of active candidates replace failed ones
    plans: State  # [B, n] after replacement
    next_score_state: Any  # after replacement
    early_stopped: Tensor | None  # [B] bool, see `planning.rollouts.candidates.SearchProblem.evaluate`


def extend_segment(
    space: SearchSpace,
    objective: Objective,
    number: int,
    here: State,
    before: State,
    score_state: Any,
    noise: Tensor | None,
    uniforms: Tensor | None,
    early_stopped: Tensor | None,
    generators: Sequence[torch.Generator] = (),
) -> ExtendedSegment:
    """Roll out segment `number` of candidates in the states `before: [B, n]`; terminated ones stay.

    For `uniforms` and `early_stopped` see `Candidates.extend_and_replace`, for `here` see `SearchSpace.extend`. The
    `generators` are used without noise only.
    """
    rollout = space.extend(number, here, before, noise, generators)
    going = score_state.active
    if early_stopped is not None:
        going = going & ~early_stopped.unsqueeze(-1)
        nothing = records.apply((rollout.code, rollout.actions), torch.zeros_like)
        code, actions = records.where(early_stopped, nothing, (rollout.code, rollout.actions))
        rollout = rollout._replace(code=code, actions=actions)
    rollout = _stay(rollout, before, going)
    after = objective.advance(score_state, number, before, rollout)
    failed = after.failed
    if early_stopped is not None:
        after, failed = records.where(early_stopped, score_state, after), failed & ~early_stopped.unsqueeze(-1)
        early_stopped = objective.early_stopped(after)
    if uniforms is None:
        return ExtendedSegment(rollout, after, None, rollout.states, after, early_stopped)
    ancestors = choose_ancestors(failed, after.active, uniforms)
    return ExtendedSegment(rollout, after, ancestors, *records.take((rollout.states, after), ancestors), early_stopped)


def _stay(rollout: SegmentRollout, before: State, active: Tensor) -> SegmentRollout:
    """Keep the states of terminated candidates, those outside `active: [B, n]`."""
    going = active[..., None, None]
    states = State(
        torch.where(going, rollout.states.centers, before.centers),
        torch.where(going, rollout.states.features, before.features),
        rollout.states.mask,
    )
    path = torch.where(going.unsqueeze(-1), rollout.path, before.centers.unsqueeze(-3))
    return rollout._replace(states=states, path=path)
