"""The ELBO term by term, on training windows and on held-out windows."""

from __future__ import annotations

import torch

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.elbo import draw_differences
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import mean_with_error
from cavin_pyro.criticism.statistics.elbo import TOTAL, adjusted_difference, scene_sizes, terms_by_window
from cavin_pyro.criticism.statistics.intervals import normal_interval
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import Verdict, conclude, grade

NAME, TITLE = "elbo", "The ELBO, term by term"
SMALL_LOSS, LARGE_LOSS = 5.0, 20.0  # nats per window


def assess_elbo(context: CheckContext, *, windows: int = 1000, samples: int = 4, batch: int = 256) -> Section:
    """Each term of -ELBO, per window, on training and on validation windows.

    f sums next_centers and next_features over the T transitions of a window; sites without a label of ours (of a
    user's own model) stand under their own names. A term of a window is its mean over samples from the guide.

    Args:
        windows: training windows, and as many held-out ones, at most.
        samples: samples of the guide for each window.
        batch: windows that are computed at once, which bounds the memory.
    """
    parts = {
        "training": context.trained_on(windows),
        "validation": context.held_out(windows),
    }
    with seeded(context.seed):
        terms = {
            name: terms_by_window(context.model, context.guide, part, samples, batch)
            for name, (part, _) in parts.items()
        }
    values = {
        name: {term: mean_with_error(value, parts[name][1]) for term, value in found.items()}
        for name, found in terms.items()
    }
    covariates = torch.cat([scene_sizes(part) for part, _ in parts.values()])
    held_out = torch.arange(len(covariates)) >= len(parts["training"][1])
    # An episode is either in training or held out, so its number alone may name two: the sign tells them apart.
    clusters = torch.cat([parts["training"][1], -1 - parts["validation"][1]])
    differences = {
        term: adjusted_difference(torch.cat([found[term] for found in terms.values()]), held_out, covariates, clusters)
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
        "and unit vectors, so likelihood terms may be negative: read their differences. ± is one standard error, "
        "clustered by episode, since windows of one episode overlap. The last state of a window is scored twice, by h "
        "as the subgoal and by f as the last transition: so the sum is a bound on the density of the program's sites, "
        "with two observations of that state, and no log density of a window. The difference is taken at equal "
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
        [_picture(differences)],
        _verdict(differences[TOTAL], counts["validation"], parts["validation"][1]),
    )


def _verdict(total: dict[str, float], windows: int, episodes: torch.Tensor) -> Verdict:
    rule = (
        "How much worse -ELBO is on held-out windows: good if its 95 % interval over episodes ends below "
        f"{SMALL_LOSS:g} nats, bad if it begins above {LARGE_LOSS:g}."
    )
    advice = "The model overfits: collect more data, or stop training earlier."
    level = grade(*normal_interval(total), good=SMALL_LOSS, bad=LARGE_LOSS)
    return conclude(level, rule, advice, windows=windows, episodes=episodes)


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


def _picture(differences: dict[str, dict[str, float]]) -> Picture:
    caption = "Each term on windows held out, less the same on training windows, with two standard errors."
    return Picture("elbo_terms", caption, draw_differences(differences))
