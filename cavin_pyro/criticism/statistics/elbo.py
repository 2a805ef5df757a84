"""Terms of the ELBO by window, and their difference between two sets of windows."""

from __future__ import annotations

import torch
from torch import Tensor

from cavin_pyro.criticism.statistics.clusters import clustered_error
from cavin_pyro.training.elbo import Program, window_terms
from models.state import Window

LABELS = {
    "nll_next_centers": "f: next states",
    "nll_next_features": "f: next states",
    "nll_subgoal_centers": "h: subgoal centres",
    "nll_subgoal_features": "h: subgoal features",
    "nll_actions": "g: actions",
    "kl_effect_code": "KL of c",
    "kl_motion_code": "KL of z",
}
TOTAL = "-ELBO"
Terms = dict[str, Tensor]


@torch.no_grad()
def terms_by_window(model: Program, guide: Program, window: Window, samples: int, batch: int) -> Terms:
    """Terms of -ELBO by label, and their sum, for each window: `[B]` float64."""
    found: dict[str, list[Tensor]] = {}
    for start in range(0, len(window.actions), batch):
        part = window.map(lambda field, rows=slice(start, start + batch): field[rows])  # type: ignore[misc]
        terms: Terms = {}
        for name, term in window_terms(model, guide, part, particles=samples).items():
            label = LABELS.get(name, name)
            terms[label] = terms.get(label, torch.zeros(())) + term.double().mean(0)
        terms[TOTAL] = torch.stack(list(terms.values())).sum(0)
        for label, term in terms.items():
            found.setdefault(label, []).append(term)
    return {label: torch.cat(parts) for label, parts in found.items()}


def scene_sizes(window: Window) -> Tensor:
    """What likelihood terms grow with, whatever the model: real objects, and objects in transitions that count.

    `[B, 2]` float64.
    """
    before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
    moves = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    subgoals = window.first.mask & window.last.mask
    return torch.stack((subgoals.sum(-1), moves.sum((-2, -1))), -1).double()


def adjusted_difference(
    values: Tensor, held_out: Tensor, covariates: Tensor, episodes: Tensor | None = None
) -> dict[str, float]:
    """Mean of `values: [N]` where `held_out: [N]` less the mean elsewhere, at equal `covariates: [N, C]`.

    The coefficient of a linear regression, with its standard error clustered by `episodes: [N]` (Liang and Zeger,
    1986); without them every value is its own (White, 1980).
    """
    centered = covariates - covariates.mean(0)
    design = torch.cat((torch.stack((torch.ones(len(values)), held_out), -1).double(), centered), -1)
    inverse = torch.linalg.pinv(design)  # [2 + C, N]; covariates may depend on each other
    coefficients = inverse @ values
    influences = len(values) * inverse[1] * (values - design @ coefficients)
    episodes = torch.arange(len(values)) if episodes is None else episodes
    return {"mean": coefficients[1].item(), "standard_error": clustered_error(influences, episodes)}
