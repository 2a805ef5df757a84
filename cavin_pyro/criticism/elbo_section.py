"""The ELBO term by term, on windows that training saw and on windows that were held out."""

from __future__ import annotations

import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.sampling import mean_with_error, seeded, some_windows
from cavin_pyro.criticism.section import Picture, Section, Subject, Table
from cavin_pyro.elbo import window_terms
from models.state import Window

NAME, TITLE = "elbo", "The ELBO, term by term"
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


def assess_elbo(subject: Subject, *, windows: int = 2000, draws: int = 4, batch: int = 256) -> Section:
    """Each term of -ELBO, per window, on training and on validation windows.

    f sums next_centers and next_features over the T transitions of a window; sites without a label of ours (of a
    user's own model) stand under their own names. A term of a window is its mean over `draws` draws from the guide.

    Args:
        windows: at most so many of each. batch: bounds the memory.
    """
    parts = {
        name: some_windows(window, windows, subject.seed)
        for name, window in (("training", subject.training), ("validation", subject.validation))
    }
    with seeded(subject.seed):
        terms = {name: terms_by_window(subject, part, draws, batch) for name, part in parts.items()}
    values = {name: {term: mean_with_error(value) for term, value in found.items()} for name, found in terms.items()}
    covariates = torch.cat([scene_sizes(part) for part in parts.values()])
    held_out = torch.arange(len(covariates)) >= len(parts["training"].actions)
    differences = {
        term: adjusted_difference(torch.cat([found[term] for found in terms.values()]), held_out, covariates)
        for term in terms["training"]
    }
    counts = {name: len(found[TOTAL]) for name, found in terms.items()}
    rows = [
        [term]
        + [_with_error(values[name][term]) for name in ("training", "validation")]
        + [_with_error(differences[term])]
        for term in differences
    ]
    explanation = (
        "Nats per window; every term is minus a log density (or a KL), so smaller is better. Densities are of metres "
        "and unit vectors, so likelihood terms may be negative: read their differences. ± is one standard error over "
        "windows; windows of one episode overlap, which makes it a little small. The difference is taken at equal "
        "numbers of objects (by linear regression), which density terms grow with. "
        f"{counts['training']} training and {counts['validation']} validation windows."
    )
    return Section(
        NAME,
        TITLE,
        explanation,
        _findings(differences),
        {**values, "difference": differences, "windows": counts},
        [Table(["term", "training", "validation", "validation - training"], rows)],
        [_draw(differences)],
    )


@torch.no_grad()
def terms_by_window(subject: Subject, window: Window, draws: int, batch: int) -> Terms:
    """Terms of -ELBO by label, and their sum, for each window: `[B]` float64."""
    found: dict[str, list[Tensor]] = {}
    for start in range(0, len(window.actions), batch):
        part = window.map(lambda field, rows=slice(start, start + batch): field[rows])  # type: ignore[misc]
        terms: Terms = {}
        for name, term in window_terms(subject.model, subject.guide, part, particles=draws).items():
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


def adjusted_difference(values: Tensor, held_out: Tensor, covariates: Tensor) -> dict[str, float]:
    """Mean of `values: [N]` where `held_out: [N]` less the mean elsewhere, at equal `covariates: [N, C]`.

    The coefficient of a linear regression, with its heteroscedastic standard error (White, 1980).
    """
    centered = covariates - covariates.mean(0)
    design = torch.cat((torch.stack((torch.ones(len(values)), held_out), -1).double(), centered), -1)
    inverse = torch.linalg.pinv(design)  # [2 + C, N]; covariates may depend on each other
    coefficients = inverse @ values
    error = (inverse[1] * (values - design @ coefficients)).square().sum().sqrt()
    return {"mean": coefficients[1].item(), "standard_error": error.item()}


def _with_error(value: dict[str, float]) -> str:
    return f"{value['mean']:.2f} ± {value['standard_error']:.2f}"


def _findings(differences: dict[str, dict[str, float]]) -> list[str]:
    total = differences[TOTAL]
    clear = abs(total["mean"]) > 2 * total["standard_error"]
    worse = "worse" if total["mean"] > 0 else "better"
    sentences = [
        f"On validation windows the ELBO is {abs(total['mean']):.1f} ± {total['standard_error']:.1f} nats {worse} than "
        f"on training windows, {'more' if clear else 'not more'} than chance explains."
    ]
    parts = {term: value for term, value in differences.items() if term != TOTAL}
    term = max(parts, key=lambda name: parts[name]["mean"] / max(parts[name]["standard_error"], 1e-12))
    if parts[term]["mean"] > 2 * parts[term]["standard_error"]:
        sentences.append(f"The clearest loss is in {term}: {_with_error(parts[term])} nats per window.")
    return sentences


def _draw(differences: dict[str, dict[str, float]]) -> Picture:
    terms = list(differences)
    figure = Figure(figsize=(6.5, 0.9 + 0.34 * len(terms)), layout="constrained")
    panel = figure.subplots()
    means = [differences[term]["mean"] for term in terms]
    errors = [2 * differences[term]["standard_error"] for term in terms]
    panel.errorbar(means, range(len(terms)), xerr=errors, color="#0072B2", marker="o", linestyle="", capsize=3)
    panel.axvline(0.0, color="#9A9A9A", linestyle="--", linewidth=1.0)
    panel.set(yticks=range(len(terms)), yticklabels=terms, xlabel="validation minus training (nats per window)")
    panel.invert_yaxis()
    panel.grid(axis="x", color="#DDDDDD", linewidth=0.6)
    panel.spines[["top", "right"]].set_visible(False)
    caption = "Each term on windows held out, less the same on training windows, with two standard errors."
    return Picture("elbo_terms", caption, figure)
