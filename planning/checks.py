"""Checks of the planners' arguments: one clear line for bad input."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch

from cavin_pyro.models.checks import check_number, typed
from cavin_pyro.models.state import State


class NoFiniteCandidateError(ValueError):
    """No candidate of one environment of a batch is finite; `what` says which numbers are not."""

    def __init__(self, environment: int, what: str) -> None:
        super().__init__(f"environment {environment}: {what}")
        self.environment, self.what = environment, what

    def __reduce__(self) -> tuple[type[NoFiniteCandidateError], tuple[int, str]]:
        """How a worker process hands it to its parent: exceptions are rebuilt from their message alone otherwise."""
        return type(self), (self.environment, self.what)


class OptimizerError(ValueError):
    """An optimizer breaks the interface `cavin_pyro.planning.optimizers.Optimizer`; the message names its class."""


class UnsuitedError(ValueError):
    """A planner or an addition asks for what this world or this machine does not have."""


def check_horizon(horizon: int, segment_length: int) -> None:
    """Raise ValueError, naming the nearest valid ones, unless H is a positive multiple of T (section 3.2)."""
    check_number("horizon", horizon, 1, whole=True)
    if horizon % segment_length:
        below = horizon - horizon % segment_length
        nearest = [str(valid) for valid in (below, below + segment_length) if valid > 0]
        raise ValueError(
            f"horizon={horizon} is not divisible by the model's segment length T={segment_length}: "
            f"choose {' or '.join(nearest)}"
        )


@typed(ValueError)
def check_scenes(
    state: State,
    generators: Sequence[torch.Generator],
    steps_left: int | None = None,
    observed: tuple[Any, ...] | None = None,
) -> None:
    """Raise ValueError unless `state` is a batch `[B]`, each finite and with an object and a generator of its own."""
    centers = state.centers
    check_number("steps_left", 1 if steps_left is None else steps_left, 1, whole=True)
    if centers.ndim != 3 or state.mask.shape != centers.shape[:-1] or not len(centers):
        raise ValueError(
            "a planner takes states of at least one scene, with centers [B, M, P] and mask [B, M], "
            f"not {list(centers.shape)} and {list(state.mask.shape)}"
        )
    if not state.mask.any(-1).all():
        raise ValueError("a planner takes scenes of at least one object, and the mask of one has none")
    if state.features.ndim != 3 or state.features.shape[:-1] != centers.shape[:-1]:
        raise ValueError(
            f"a planner takes states with features [B, M, F], not {list(state.features.shape)} for centers "
            f"{list(centers.shape)}"
        )
    kinds = centers.dtype, state.features.dtype, state.mask.dtype
    if kinds[:2] != (torch.float32, torch.float32) or kinds[2] != torch.bool:
        found = ", ".join(str(kind).removeprefix("torch.") for kind in kinds)
        raise ValueError(f"a planner takes centers and features of float32 and a mask of bool, not {found}")
    for name in ("centers", "features"):
        wrong = ~getattr(state, name).isfinite().all(-1) & state.mask
        if wrong.any():
            raise NoFiniteCandidateError(int(wrong.any(-1).nonzero()[0]), f"the {name} of its state are not finite")
    if len(generators) != len(centers):
        raise ValueError(f"one generator per environment: {len(centers)} needed, {len(generators)} given")
    if len({id(generator) for generator in generators}) != len(generators):
        raise ValueError("one generator per environment: the same generator was given twice")
