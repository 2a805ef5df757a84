"""Does the bound fit? The ELBO term by term, on training windows and on held-out windows."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.codes import SYMBOLS, sample_guide
from cavin_pyro.criticism.estimates import Interval, clustered_interval, mean_interval
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.section import Section, conclude, grade
from cavin_pyro.criticism.windows import seeded
from cavin_pyro.models.state import Window
from cavin_pyro.training.elbo import Program, window_terms

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
SMALL_LOSS, LARGE_LOSS = 5.0, 20.0  # nats per window
ACTIVE = 0.01  # variance of the posterior mean, of codes whose prior has a variance of about one
BATCH = 256  # windows that are computed at once, which bounds the memory
SAMPLES_FOR_MEANS = 64  # of each window's codes, to find the active dimensions

EXPLANATION = (
    "Nats per window of {training} training and {validation} held-out windows; every term is minus a log density (or "
    "a KL), so smaller is better. Densities are of lengths and features, so likelihood terms may be negative. The "
    "last state of a window is scored twice, by h as the subgoal and by f as the last transition, so the sum is no "
    "log density of a window. Differences are taken at equal numbers of objects, by linear regression. A dimension "
    "of a code is active where its posterior mean varies by more than {active} over windows."
)


def assess_elbo(context: CheckContext, *, windows: int = 1000, samples: int = 4) -> Section:
    """Each term of -ELBO, per window, on training and on held-out windows; and how many dimensions of codes are in use.

    f sums next_centers and next_features over the T transitions of a window; sites without a label of ours (of a
    user's own model) stand under their own names. A term of a window is its mean over samples from the guide.

    `windows`: training windows, and as many held-out ones, at most. `samples`: samples of the guide for each window.
    """
    parts = {"training": context.trained_on(windows), "validation": context.held_out(windows)}
    with seeded(context.seed):
        terms = {
            name: terms_by_window(context.model, context.guide, part, samples) for name, (part, _) in parts.items()
        }
        active = active_dimensions(context, parts["validation"][0])
    means = {
        name: {term: mean_interval(value, parts[name][1]) for term, value in of_part.items()}
        for name, of_part in terms.items()
    }
    covariates = torch.cat([scene_sizes(part) for part, _ in parts.values()])
    held_out = torch.arange(len(covariates)) >= len(parts["training"][1])
    # An episode is either in training or held out, so its number alone may name two: the sign tells them apart.
    clusters = torch.cat([parts["training"][1], -1 - parts["validation"][1]])
    differences = {
        term: adjusted_difference(
            torch.cat([of_part[term] for of_part in terms.values()]), held_out, covariates, clusters
        )
        for term in terms["training"]
    }
    counts = {name: len(episodes) for name, (_, episodes) in parts.items()}
    total = differences[TOTAL]
    return Section(
        EXPLANATION.format(active=ACTIVE, **counts),
        conclude(
            grade(total.low, total.high, good=SMALL_LOSS, bad=LARGE_LOSS),
            f"How much worse -ELBO is on held-out windows: good if its 95 % interval over episodes ends below "
            f"{SMALL_LOSS:g} nats, bad if it begins above {LARGE_LOSS:g}.",
            "The model overfits: collect more data, or stop training earlier.",
            parts["validation"][1],
        ),
        _findings(differences, means["validation"], active),
        {**means, "difference": differences, "active": active, "windows": counts},
        "-ELBO, held-out minus training windows (nats)",
        total,
        figure=_figure(differences),
        caption="Each term on held-out windows minus the same on training windows, with 95 % intervals over episodes.",
    )


@torch.no_grad()
def terms_by_window(model: Program, guide: Program, window: Window, samples: int) -> dict[str, Tensor]:
    """Terms of -ELBO by label, and their sum, for each window: `[B]` float64."""
    pieces: dict[str, list[Tensor]] = {}
    for start in range(0, len(window.actions), BATCH):
        part = window.map(lambda field, rows=slice(start, start + BATCH): field[rows])  # type: ignore[misc]
        terms: dict[str, Tensor] = {}
        for name, term in window_terms(model, guide, part, particles=samples).items():
            label = LABELS.get(name, name)
            terms[label] = terms.get(label, torch.zeros(())) + term.double().mean(0)
        terms[TOTAL] = torch.stack(list(terms.values())).sum(0)
        for label, term in terms.items():
            pieces.setdefault(label, []).append(term)
    return {label: torch.cat(parts) for label, parts in pieces.items()}


def scene_sizes(window: Window) -> Tensor:
    """What likelihood terms grow with, whatever the model: real objects, and objects in transitions that count.

    `[B, 2]` float64.
    """
    before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
    moves = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    subgoals = window.first.mask & window.last.mask
    return torch.stack((subgoals.sum(-1), moves.sum((-2, -1))), -1).double()


def adjusted_difference(values: Tensor, held_out: Tensor, covariates: Tensor, episodes: Tensor) -> Interval:
    """Mean of `values: [N]` where `held_out: [N]` less the mean elsewhere, at equal `covariates: [N, C]`.

    The coefficient of a linear regression, with an interval clustered by `episodes: [N]` (Liang and Zeger, 1986).
    """
    centered = covariates - covariates.mean(0)
    design = torch.cat((torch.stack((torch.ones(len(values)), held_out), -1).double(), centered), -1)
    inverse = torch.linalg.pinv(design)  # [2 + C, N]; covariates may depend on each other
    coefficients = inverse @ values
    influences = len(values) * inverse[1] * (values - design @ coefficients)
    return clustered_interval(coefficients[1].item(), influences, episodes)


def active_dimensions(context: CheckContext, window: Window) -> dict[str, dict[str, int]]:
    """How many `dimensions` each code has, and how many of them are `active` in windows `[B]`, by the code's symbol.

    Codes that are no vectors of numbers are left out.
    """
    if not context.codes:
        return {}
    return {
        SYMBOLS.get(name, name): {
            "active": int((posterior_mean_variance(samples) > ACTIVE).sum()),
            "dimensions": samples.shape[-1],
        }
        for name, samples in sample_guide(context.guide, window, SAMPLES_FOR_MEANS).items()
        if samples.is_floating_point() and samples.dim() == 3
    }


def posterior_mean_variance(samples: Tensor) -> Tensor:
    """Variance over windows of the posterior mean, of samples `[N, B, D]`: `[D]` (Burda et al., 2016).

    The mean of N samples varies by itself; that much is taken off, so an unused dimension comes out near zero.
    """
    return samples.mean(0).var(0) - samples.var(0).mean(0) / len(samples)


def _findings(
    differences: Mapping[str, Interval], held_out: Mapping[str, Interval], active: Mapping[str, Mapping[str, int]]
) -> list[str]:
    total = differences[TOTAL]
    clear = "more" if total.low > 0 or total.high < 0 else "not more"
    sentences = [
        f"On held-out windows -ELBO is {total.text(1)} nats higher than on training windows, {clear} than chance "
        "explains."
    ]
    losses = {term: interval for term, interval in differences.items() if term != TOTAL and interval.low > 0}
    if losses:
        term = max(losses, key=lambda name: losses[name].mean)
        sentences.append(f"The largest clear loss is in {term}: {losses[term].text()} nats per window.")
    for symbol, count in active.items():
        cost = held_out[f"KL of {symbol}"].text() if f"KL of {symbol}" in held_out else "unknown"
        sentences.append(
            f"{symbol} has {count['active']} active dimensions of {count['dimensions']} and costs {cost} nats."
        )
    return sentences


def _figure(differences: Mapping[str, Interval]) -> Figure:
    terms = list(differences)
    figure = Figure(figsize=(6.5, 0.9 + 0.34 * len(terms)), layout="constrained")
    panel = figure.subplots()
    mean, low, high = torch.tensor(list(differences.values())).T
    panel.errorbar(mean, range(len(terms)), xerr=torch.stack((mean - low, high - mean)), fmt="o", color="#0072B2")
    panel.axvline(0.0, color="#9A9A9A", linestyle="--", linewidth=1.0)
    panel.set(yticks=range(len(terms)), yticklabels=terms, xlabel="held-out minus training (nats per window)")
    panel.invert_yaxis()
    return figure
