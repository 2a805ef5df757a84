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
COLORS = {"training": "#0072B2", "validation": "#D55E00"}
Terms = dict[str, Tensor]


def assess_elbo(subject: Subject, *, windows: int = 2000, draws: int = 4, batch: int = 256) -> Section:
    """Each term of -ELBO, per window, on training and on validation windows.

    f sums next_centers and next_features over the T transitions of a window; sites without a label of ours (of a
    user's own model) stand under their own names. A term of a window is its mean over `draws` draws from the guide.

    Args:
        windows: at most so many of each. batch: bounds the memory.
    """
    chosen = {"training": subject.training, "validation": subject.validation}
    with seeded(subject.seed):
        terms = {
            name: terms_by_window(subject, some_windows(window, windows, subject.seed), draws, batch)
            for name, window in chosen.items()
        }
    values = {name: {term: mean_with_error(value) for term, value in found.items()} for name, found in terms.items()}
    differences = {
        term: {
            "mean": held_out["mean"] - values["training"][term]["mean"],
            "standard_error": (held_out["standard_error"] ** 2 + values["training"][term]["standard_error"] ** 2)
            ** 0.5,
        }
        for term, held_out in values["validation"].items()
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
        "windows; windows of one episode overlap, which makes it a little small. "
        f"{counts['training']} training and {counts['validation']} validation windows."
    )
    return Section(
        NAME,
        TITLE,
        explanation,
        _findings(differences),
        {**values, "difference": differences, "windows": counts},
        [Table(["term", "training", "validation", "validation - training"], rows)],
        [_draw(values)],
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


def _draw(values: dict[str, dict[str, dict[str, float]]]) -> Picture:
    terms = list(values["training"])
    figure = Figure(figsize=(1.5 + 1.25 * len(terms), 3.2), layout="constrained")
    for panel, term in zip(figure.subplots(1, len(terms), squeeze=False)[0], terms, strict=True):
        for place, (name, color) in enumerate(COLORS.items()):
            value = values[name][term]
            panel.errorbar(
                place, value["mean"], 2 * value["standard_error"], color=color, marker="o", capsize=4, label=name
            )
        panel.set_title(term.replace(": ", "\n"), fontsize=9)
        panel.set(xlim=(-0.6, 1.6), xticks=[])
        panel.tick_params(labelsize=8)
        panel.grid(axis="y", color="#DDDDDD", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    figure.axes[0].set_ylabel("nats per window", fontsize=9)
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=2, fontsize=9, frameon=False)
    caption = "Each term on its own scale, with two standard errors; lower is better."
    return Picture("elbo_terms", caption, figure)
