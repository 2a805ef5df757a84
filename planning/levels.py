"""What is searched: effect codes, motion codes, or raw pushes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor
from torch.distributions import Distribution

from models.state import State
from planning import returns
from planning.following import follow
from planning.proposals import Proposal
from planning.protocol import PlanningModel
from planning.sampling import codes_each, noise_each, sample_each
from planning.segments import Stretch, of_segment


class EffectLevel(NamedTuple):
    """Effect codes, and the subgoals that h predicts from them (Algorithm 1, lines 5 and 6)."""

    model: PlanningModel

    @property
    def dimension(self) -> int:
        """C."""
        return self.model.effect_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> Stretch:
        """See `planning.candidates.Level`."""
        # Line 5, a segment at a time: a learned prior p(c | s) has to see the state that it goes on from.
        code = _codes(self.model.effect_prior, [plans], noise, generators)
        return predicted_effect(self.model, here, plans, code)


class MotionLevel(NamedTuple):
    """Motion codes, the pushes that g makes of them, and where f says that these lead (lines 8 and 9).

    effect_codes: `[B, K, C]`, which every plan is paired with; None for a model without effects (CVAE-MPC).
    """

    model: PlanningModel
    effect_codes: Tensor | None

    @property
    def dimension(self) -> int:
        """Z."""
        return self.model.motion_dimension

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> Stretch:
        """See `planning.candidates.Level`."""
        effects = self._effects(segment, plans.batch_shape[-1])
        # Line 8, a segment at a time as in line 5; every sequence is paired with the chosen effect codes.
        code = _codes(self.model.motion_prior, [plans, *effects], noise, generators)
        # Line 9: the actions by g, from the state that f predicted; the states by f, an action at a time.
        generate: Callable[..., Tensor] = self.model.actions  # models without effects take theirs by keyword
        pushes = generate(here, *effects, code) if effects else generate(here, motion_code=code)
        states, path = follow(self.model, here, pushes)
        return Stretch(code, pushes, states, path)

    def _effects(self, segment: int, count: int) -> list[Tensor]:
        if self.effect_codes is None:
            return []
        return [of_segment(self.effect_codes, segment).expand(-1, count, -1)]


class PushLevel(NamedTuple):
    """Raw pushes, T a segment, and where f says that they lead (MPC, appendix A.2)."""

    model: PlanningModel
    proposal: Proposal

    @property
    def dimension(self) -> int:
        """What the proposal takes for T pushes."""
        return self.proposal.held + self.model.segment_length * self.proposal.own

    def extend(
        self, segment: int, here: State, plans: State, noise: Tensor | None, generators: Sequence[torch.Generator]
    ) -> Stretch:
        """See `planning.candidates.Level`."""
        if noise is None:
            noise = noise_each((plans.batch_shape[-1], self.dimension), generators)
        held, pushes, path = noise[..., : self.proposal.held], [], []
        for own in noise[..., self.proposal.held :].split(self.proposal.own, -1):
            push = self.proposal(plans, held, own).unsqueeze(-2)
            plans, step = follow(self.model, here, push)
            here = plans
            pushes.append(push)
            path.append(step)
        actions = torch.cat(pushes, -2)
        return Stretch(actions.flatten(-2), actions, plans, torch.cat(path, -3))


def predicted_effect(model: PlanningModel, here: State, plans: State, code: Tensor) -> Stretch:
    """Line 6: predict the subgoals with h, recursively, and interpolate the states between them.

    `here`: `plans: [B, n]`, or `[B, 1]` where all are in one state; `code: [B, n, C]`.
    """
    subgoal = model.subgoal(here, code).expand(plans.batch_shape)
    return Stretch(code, None, subgoal, returns.interpolate(plans.centers, subgoal.centers, model.segment_length))


def _codes(
    prior: Callable[..., Distribution],
    conditions: Sequence[State | Tensor],
    noise: Tensor | None,
    generators: Sequence[torch.Generator],
) -> Tensor:
    return sample_each(prior, conditions, generators) if noise is None else codes_each(prior, conditions, noise)
