"""How much information the codes carry."""

from __future__ import annotations

from typing import Any

import torch

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.codes import draw_dimensions
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.codes import SYMBOLS, mean_with_error, sample_guide, some_windows, without_codes
from cavin_pyro.criticism.statistics.information import (
    ACTIVE,
    dimension_kl,
    mutual_information,
    posterior_mean_variance,
)
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.training.elbo import window_terms

NAME, TITLE = "codes", "What the codes carry"


def assess_codes(context: CheckContext, *, windows: int = 1000, samples: int = 64, pairs: int = 400) -> Section:
    """Active dimensions, nats per dimension, and information, on validation windows.

    Args:
        windows: for dimensions and KL. samples: of the codes of each. pairs: windows among which the aggregate
            posterior is estimated (its cost grows with the square).
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    model, guide = context.model, context.guide
    window = some_windows(context.validation, windows, context.seed)
    few = some_windows(context.validation, pairs, context.seed)
    with seeded(context.seed), torch.no_grad():
        posterior = sample_guide(guide, window, samples)
        kl = dimension_kl(model, guide, window)
        terms = window_terms(model, guide, window, particles=4)
        single = {name: value[0] for name, value in sample_guide(guide, few, 1).items()}
        information = {name: mutual_information(guide, few, single, name) for name in context.codes}
    values: dict[str, Any] = {}
    for name in context.codes:
        variance = posterior_mean_variance(posterior[name])
        # Exact where the KL is known in closed form; otherwise an estimate from samples.
        whole = kl[name].sum(-1) if name in kl else terms[f"kl_{name}"].double().mean(0)
        rate = mean_with_error(whole)
        values[name] = {
            "dimensions": len(variance),
            "active": int((variance > ACTIVE).sum()),
            "mean_variance": variance.tolist(),
            "kl": rate,
            "kl_by_dimension": kl[name].mean(0).tolist() if name in kl else None,
            "information": information[name]._asdict(),
            "aggregate_kl": {
                "low": rate["mean"] - min(information[name].upper, rate["mean"]),
                "high": rate["mean"] - information[name].lower,
            },
        }
    values["windows"] = {"dimensions": len(window.actions), "information": len(few.actions)}
    explanation = (
        f"A dimension is active where its posterior mean varies by more than {ACTIVE} over windows. E KL(q | p) is an "
        "upper bound on the information I(c; s'|s), or I(z; a|s, c). The part of it that is not information is "
        "KL(aggregate posterior | prior). The aggregate posterior is estimated as the mean of q over other windows: "
        "without the window itself for the upper, with it for the lower bound, which cannot exceed the logarithm of "
        f"the number of windows ({len(few.actions)}). These bounds are on the information between a code and all that "
        "it is inferred from, I(c; s, s') and I(z; s, a, c): to condition on the state one would need several windows "
        "from each. Conditioned on s, c can only carry less."
    )
    return Section(
        NAME, TITLE, explanation, _findings(values, context.codes), values, [_table(values, context.codes)],
        [_picture(values, context.codes)],
    )  # fmt: skip


def _findings(values: dict[str, Any], codes: tuple[str, ...]) -> list[str]:
    sentences = []
    for name in codes:
        one = values[name]
        low, high = max(one["information"]["lower"], 0.0), min(one["information"]["upper"], one["kl"]["mean"])
        rate, aggregate = one["kl"], max(one["aggregate_kl"]["high"], 0.0)
        sentences.append(
            f"{SYMBOLS[name]} has {one['active']} active dimensions of {one['dimensions']} and costs "
            f"{rate['mean']:.2f} ± {rate['standard_error']:.2f} nats; between {min(low, high):.2f} and {high:.2f} of "
            f"them tell windows apart, so KL(aggregate | prior) is at most {aggregate:.2f}."
        )
    return sentences


def _table(values: dict[str, Any], codes: tuple[str, ...]) -> Table:
    header = [
        "code",
        "dimensions",
        "active",
        "E KL(q | p)",
        "information, at least",
        "at most",
        "aggregate KL, at most",
    ]
    rows = []
    for name in codes:
        one = values[name]
        bounds = one["information"]
        row = [SYMBOLS[name], one["dimensions"], one["active"], one["kl"]["mean"], bounds["lower"]]
        rows.append([*row, min(bounds["upper"], one["kl"]["mean"]), one["aggregate_kl"]["high"]])
    return Table(header, rows, digits=2)


def _picture(values: dict[str, Any], codes: tuple[str, ...]) -> Picture:
    caption = (
        "Per dimension: how much the posterior mean varies over windows (above the dashed line a dimension is active), "
        "and how many nats it costs. Nothing is shown below where the guide or the prior is no diagonal Gaussian."
    )
    return Picture("codes", caption, draw_dimensions(values, codes))
