"""Replicated windows: the values that a model's program generates."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import torch
from pyro import poutine
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.elbo import sampled_sites, substitute

WINDOWS_AT_ONCE = 4096  # a few megabytes per layer, so that a pass stays in the processor's cache


class GeneratedWindow(NamedTuple):
    """Actions and states of windows `[B]`, observed or generated."""

    first: State  # [B], the state s
    actions: Tensor  # [B, T, A] normalised
    steps: Tensor  # [B, T, M, P] centres after each action, from f
    subgoal: Tensor | None  # [B, M, P] centres after the segment, from h; None for a model without h
    chosen: bool = True  # whether the actions are the model's own


@contextmanager
def seeded(seed: int) -> Iterator[None]:
    """Seed torch inside the block, and restore its generator afterwards."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        yield


def observed(window: Window) -> GeneratedWindow:
    """The windows `[B]` themselves."""
    return GeneratedWindow(window.first, window.actions, window.states.centers[:, 1:], window.last.centers)


def generated(
    model: Model,
    window: Window,
    *,
    guide: Guide | None = None,
    means: Sequence[str] | None = None,
    codes: Mapping[str, Tensor] | None = None,
) -> GeneratedWindow:
    """Generate once from the first state of each window `[B]`.

    Args:
        guide: where the codes come from; by default the model's own prior given s.
        means: names of the codes. If given, everything else takes the mean of its likelihood, as planning does;
            by default everything is sampled.
        codes: `[B, D]` by name, in place of samples.
    """
    program: Any = substitute(model.generate, codes or {})
    if means is not None:
        program = _Means(means)(program)
    values = sampled_values(program, window, guide)
    return GeneratedWindow(
        first=window.first,
        actions=values.get("actions", window.actions),
        steps=all_pushes(values, "next_centers"),
        subgoal=values.get("subgoal_centers"),
        chosen="actions" in values,
    )


def sampled_values(program: Any, window: Window, guide: Guide | None = None) -> dict[str, Tensor]:
    """The value of every site that one run of a program has sampled or observed, with the codes of a guide if given."""
    if guide is not None:
        program = poutine.replay(program, trace=poutine.trace(guide).get_trace(window))
    sites = sampled_sites(poutine.trace(program).get_trace(window))
    return {name: site["value"] for name, site in sites.items()}


def all_pushes(values: Mapping[str, Tensor], site: str) -> Tensor:
    """A site that generation samples push by push, of all T pushes: `[..., T, M, D]`."""
    steps = [values[f"{site}_{push}"] for push in range(1, len(values) + 1) if f"{site}_{push}" in values]
    return torch.stack(steps, -3)


def batches(samples: int, window: Window) -> list[slice]:
    """The parts of so many samples of windows `[B]` that are computed at once."""
    each = max(1, WINDOWS_AT_ONCE // max(1, len(window.actions)))
    return [slice(start, min(start + each, samples)) for start in range(0, samples, each)]


def replicated(window: Window, copies: int, make: Callable[[Window], Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """What `make` makes, by name, of copies of windows `[B]`, in batches of some copies: `[copies, B, ...]`."""
    # Longer batches instead of a further dimension: they suit every model, and cost the same.
    parts: dict[str, list[Tensor]] = {}
    for some in batches(copies, window):
        count = some.stop - some.start
        batch = window.map(lambda field, count=count: field.repeat(count, *[1] * (field.dim() - 1)))  # type: ignore[misc]
        for name, values in make(batch).items():
            parts.setdefault(name, []).append(values.unflatten(0, (count, -1)))
    return {name: torch.cat(values) for name, values in parts.items()}


class _Means(Messenger):
    """Gives every latent site but the codes the mean of its distribution; discrete ones have none and are sampled."""

    def __init__(self, codes: Sequence[str]) -> None:
        super().__init__()
        self._codes = codes

    def _pyro_sample(self, message: Any) -> None:
        if message["is_observed"] or message["name"] in self._codes or site_is_subsample(message):
            return
        if message["fn"].has_enumerate_support:
            return
        message["value"], message["done"] = message["fn"].mean, True
