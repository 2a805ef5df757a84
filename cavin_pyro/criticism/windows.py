"""What programs and guides sample: windows of a model, and codes with their importance weights, by Pyro's traces."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import pyro
import torch
from pyro import poutine
from pyro.poutine.messenger import Messenger
from pyro.poutine.util import site_is_subsample
from torch import Tensor

from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.guides.guide import Guide
from cavin_pyro.models.model import Model
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.elbo import Program, latent_sites, sampled_sites, substitute, window_terms

WINDOWS_AT_ONCE = 4096  # a few megabytes per layer, so that a pass stays in the processor's cache
NO_CODES = "The model has no codes, so there is nothing to check here."
SYMBOLS = {"effect_code": "c", "motion_code": "z"}  # the paper's symbols
Codes = dict[str, Tensor]


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


def replicated(window: Window, copies: int, make: Callable[[Window], Mapping[str, Tensor]]) -> dict[str, Tensor]:
    """What `make` makes, by name, of copies of windows `[B]`, in batches of some copies: `[copies, B, ...]`."""
    # Longer batches instead of a further dimension: they suit every model, and cost the same.
    each = max(1, min(copies, WINDOWS_AT_ONCE // len(window.actions)))
    parts: dict[str, list[Tensor]] = {}
    for made in range(0, copies, each):
        count = min(each, copies - made)
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


@torch.no_grad()
def log_weights(
    model: Program, guide: Program, window: Window, particles: int, *, fixed: Mapping[str, Tensor] | None = None
) -> Tensor:
    """Logarithms of p(observed, codes) / q(codes) for K samples of the codes of each window `[B]`, in nats.

    Args:
        fixed: values of codes `[K, B, D]` that are not sampled. Their densities stay in the weight.

    Returns:
        `[K, B]`, float64.
    """
    pieces = []
    step = max(1, WINDOWS_AT_ONCE // max(1, len(window.actions)))
    for start in range(0, particles, step):
        here = {name: value[start : start + step] for name, value in (fixed or {}).items()}
        terms = window_terms(model, guide, window, particles=min(step, particles - start), fixed=here)
        pieces.append(-torch.stack([term.double() for term in terms.values()]).sum(0))
    return torch.cat(pieces)


@torch.no_grad()
def sample_guide(guide: Program, window: Window, samples: int) -> Codes:
    """Codes `[samples, B, D]` of each window `[B]` from the guide; from the prior, if the model takes its place."""
    pieces: dict[str, list[Tensor]] = {}
    step = max(1, WINDOWS_AT_ONCE // max(1, len(window.actions)))
    for start in range(0, samples, step):
        with pyro.plate("particles", min(step, samples - start), dim=-2):
            trace = poutine.trace(guide).get_trace(window)
        for name, site in latent_sites(trace).items():
            pieces.setdefault(name, []).append(site["value"])
    return {name: torch.cat(values) for name, values in pieces.items()}


@torch.no_grad()
def guide_density(guide: Program, window: Window, values: Codes, site: str) -> Tensor:
    """log q(value | window) at one site for `values: [K, B, D]` of all sites: `[K, B]` float64."""
    particles, pieces = len(values[site]), []
    step = max(1, WINDOWS_AT_ONCE // max(1, len(window.actions)))
    for start in range(0, particles, step):
        here = {name: value[start : start + step] for name, value in values.items()}
        with pyro.plate("particles", len(here[site]), dim=-2):
            trace = poutine.trace(substitute(guide, here)).get_trace(window)
        trace.compute_log_prob(site_filter=lambda name, _: name == site)
        pieces.append(trace.nodes[site]["log_prob"].double())
    return torch.cat(pieces)


def unsuitable_codes(context: CheckContext, window: Window) -> str:
    """Why a check of codes does not apply to a model: it has none, or some are no vectors of numbers; else empty."""
    if not context.codes:
        return NO_CODES
    with seeded(context.seed):
        sampled = sample_guide(context.guide, window.map(lambda field: field[:2]), 1)
    names = [name for name, value in sampled.items() if not value.is_floating_point() or value.dim() != 3]
    names += [name for name in context.codes if name not in sampled]
    return f"{', '.join(names)}: this check is of codes that the guide samples as vectors of numbers." if names else ""
