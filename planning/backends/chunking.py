"""Plans for many environments in chunks, to bound the memory."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import wraps
from typing import Protocol

import torch

from models.state import State
from planning import records
from planning.backends.eager import Backend
from planning.extensions.touchdown import ObservedPoints
from planning.inputs import NoFiniteCandidateError, check_scenes
from planning.plan import Plan

# Measured: a plan of 1,024 samples fills a processor's caches; sixteen plans in one pass take 1.6 times as long per
# plan. Matrix products of another number of rows may also round differently, and a plan must not depend on its
# neighbours.
ENVIRONMENTS_ON_PROCESSOR = 1
PLANS_ON_ACCELERATOR = 131_072  # samples of all environments of a chunk


class Sampling(Protocol):
    """A planner with N = `samples` candidates per environment; its backend runs the chunks."""

    samples: int
    backend: Backend


PlanMethod = Callable[..., Plan]  # (self, state, generators, previous, observed)


def chunked(plan: PlanMethod) -> PlanMethod:
    """Let a planner's method `plan` take any number of environments `[B]`, in chunks of whole environments.

    It concatenates the plans of the chunks. Raises ValueError for a state that is not a batch of scenes, for another
    number of generators than B, and for an environment without a finite candidate, which it names.
    """

    @wraps(plan)
    def planned(
        self: Sampling,
        state: State,
        generators: Sequence[torch.Generator],
        previous: Plan | None = None,
        observed: ObservedPoints | None = None,
    ) -> Plan:
        check_scenes(state, generators)
        size = ENVIRONMENTS_ON_PROCESSOR
        if state.centers.device.type != "cpu":
            size = max(1, PLANS_ON_ACCELERATOR // self.samples)

        def plan_of(start: int) -> Plan:
            chunk = slice(start, start + size)
            last = previous and records.apply(previous, lambda field: field[chunk])
            seen = observed and records.apply(observed, lambda field: field[chunk])
            try:
                return plan(self, state.scene(chunk), generators[chunk], last, seen)
            except NoFiniteCandidateError as error:
                raise NoFiniteCandidateError(start + error.environment, error.what) from error

        plans = self.backend.each(plan_of, range(0, max(len(generators), 1), size))
        return plans[0] if len(plans) == 1 else records.join(plans, dimension=0)

    return planned
