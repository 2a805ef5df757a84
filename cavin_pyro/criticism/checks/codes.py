"""How much information the codes carry."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.codes import draw_dimensions
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import mean_with_error
from cavin_pyro.criticism.statistics.codes import SYMBOLS, Codes, sample_guide, sample_prior, without_codes
from cavin_pyro.criticism.statistics.inference.information import (
    ACTIVE,
    conditional_bounds,
    dimension_kl,
    marginal_bounds,
    mutual_information,
    posterior_mean_variance,
    prior_varies,
)
from cavin_pyro.criticism.statistics.inference.simulation import simulate, simulated_information
from cavin_pyro.criticism.statistics.intervals import normal_interval
from cavin_pyro.criticism.statistics.prior.classifier import divergence_bound, held_out_logits
from cavin_pyro.criticism.statistics.prior.features import describe
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import BAD, GOOD, INSPECT, Verdict, conclude, worst
from cavin_pyro.training.elbo import window_terms
from models.model import Model
from models.state import Window

NAME, TITLE = "codes", "What the codes carry"
USED, UNUSED = 0.5, 0.1  # nats: a code that surely costs more is used, one that surely costs less is not
GIVEN = {"effect_code": "I(c; s' | s)", "motion_code": "I(z; a | s, c)"}

EXPLANATION = """
A dimension is active where its posterior mean varies by more than {active} over windows. E KL(q | p) is the sum of two
parts, for every prior: the information between a code and what it explains, given all before it, I(c; s' | s) or
I(z; a | s, c), and the divergence of the aggregate posterior from the prior at the same state. With one window for each
state, E KL(q | p) bounds both from above; a classifier's lower bound on the second (Nguyen and others, 2010) makes the
first bound tighter. No lower bound on the information is known from such data, and none is printed; in windows that the
model generates both bounds are known, since there the true code is.

The information between a code and all that it is inferred from, the state included, I(c; s, s') and I(z; s, a, c), has
bounds from {pairs} windows: the aggregate posterior is the mean of q over other windows, without the window itself for
the upper and with it for the lower bound, which cannot exceed the logarithm of their number. Only where the prior is
the same for every state does E KL(q | p) less this bound the divergence of the aggregate posterior from the prior; for
other priors it is no bound, and none is printed.
"""


@torch.no_grad()
def assess_codes(
    context: CheckContext, *, windows: int = 1000, samples: int = 64, pairs: int = 400, particles: int = 100
) -> Section:
    """Active dimensions, nats per dimension, and information, on validation windows.

    Args:
        windows: held-out windows for dimensions and KL, at most.
        samples: samples of the codes of each window.
        pairs: windows among which the aggregate posterior is estimated (its cost grows with the square), and
            generated windows.
        particles: samples of the guide for each generated window.
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    model, guide = context.model, context.guide
    window, episodes = context.held_out(windows)
    few, few_episodes = context.held_out(pairs)
    with seeded(context.seed):
        posterior = sample_guide(guide, window, samples)
        kl = dimension_kl(model, guide, window)
        terms = window_terms(model, guide, window, particles=4)
        single = {name: value[0] for name, value in sample_guide(guide, few, 1).items()}
        information = {
            name: mutual_information(guide, few, single, name, few_episodes) if len(few_episodes) > 1 else None
            for name in context.codes
        }
        divergences = _divergences(context, window, {name: value[0] for name, value in posterior.items()}, episodes)
    with seeded(context.seed):
        simulated = _simulated(context, few, few_episodes, particles) if isinstance(model, Model) else {}
    values: dict[str, Any] = {}
    for name in context.codes:
        variance = posterior_mean_variance(posterior[name])
        # Exact where the KL is known in closed form; otherwise an estimate from samples.
        whole = kl[name].sum(-1) if name in kl else terms[f"kl_{name}"].double().mean(0)
        rate = mean_with_error(whole, episodes)
        given, aggregate = conditional_bounds(rate["mean"], divergences.get(name, 0.0))
        varies, between = prior_varies(model, few, single, name), information[name]
        marginal = None if varies or between is None else marginal_bounds(rate["mean"], between, varies=varies)
        values[name] = {
            "dimensions": len(variance),
            "active": int((variance > ACTIVE).sum()),
            "mean_variance": variance.tolist(),
            "kl": rate,
            "kl_by_dimension": kl[name].mean(0).tolist() if name in kl else None,
            "information": between._asdict() if between else None,
            "prior_varies": varies,
            "information_given_state": given._asdict(),
            "aggregate_kl_given_state": aggregate._asdict(),
            "aggregate_kl": marginal._asdict() if marginal else None,
            "simulated_information": simulated.get(name),
        }
    values["windows"] = {"dimensions": len(window.actions), "information": len(few.actions)}
    explanation = " ".join(EXPLANATION.format(active=ACTIVE, pairs=len(few.actions)).split())
    findings, tables = _findings(values, context.codes), [_table(values, context.codes)]
    pictures = [_picture(values, context.codes)]
    verdict = _verdict(values, context.codes, episodes)
    return Section(NAME, TITLE, explanation, findings, values, tables, pictures, verdict)


def _divergences(context: CheckContext, window: Window, codes: Codes, episodes: Tensor) -> dict[str, float]:
    """The lower end of a classifier's bound on KL(q(code | before) | p(code | before)), by code."""
    found: dict[str, float] = {}
    if len(episodes.unique()) < 2:
        return found
    earlier: Codes = {}
    for name in context.codes:
        # What comes after this code is the prior's in both rows of a pair, and so no difference.
        pair = [
            sample_prior(context.model, window, fixed=fixed) for fixed in ({**earlier, name: codes[name]}, {**earlier})
        ]
        own, prior = (describe(context.model, window, {**values, **earlier}) for values in pair)
        logits = held_out_logits(own, prior, episodes, seed=context.seed)
        found[name] = divergence_bound(*logits, episodes).low
        earlier[name] = codes[name]
    return found


def _simulated(context: CheckContext, few: Window, episodes: Tensor, particles: int) -> dict[str, Any]:
    """Bounds on the information in windows that the model generates, by code."""
    codes, window = simulate(context.model, few)
    found = {}
    for name in codes:
        between = simulated_information(
            context.model, context.guide, codes, window, name, episodes, particles=particles
        )
        found[name] = {
            "low": between.low._asdict() if between.low else None,
            "high": between.high._asdict(),
        }
    return found


def _verdict(values: dict[str, Any], codes: tuple[str, ...], episodes: Tensor) -> Verdict:
    levels = []
    for name in codes:
        low, high = normal_interval(values[name]["kl"])
        levels.append(GOOD if low >= USED and values[name]["active"] else BAD if high <= UNUSED else INSPECT)
    rule = (
        f"Good if every code has an active dimension and costs more than {USED:g} nats at the lower end of its 95 % "
        f"interval over episodes; bad if one costs less than {UNUSED:g} at the upper end: it has collapsed."
    )
    advice = "A code without cost carries no information: lower the weight of its KL early in training, or remove it."
    windows = values["windows"]["dimensions"]
    return conclude(worst(levels), rule, advice, windows=windows, episodes=episodes)


def _findings(values: dict[str, Any], codes: tuple[str, ...]) -> list[str]:
    sentences = []
    for name in codes:
        one, symbol = values[name], SYMBOLS[name]
        rate, given, aggregate = one["kl"], one["information_given_state"], one["aggregate_kl_given_state"]
        sentences.append(
            f"{symbol} has {one['active']} active dimensions of {one['dimensions']} and costs {rate['mean']:.2f} ± "
            f"{rate['standard_error']:.2f} nats; {GIVEN[name]} is at most {given['high']:.2f} of them (no lower bound "
            f"is known), and the aggregate posterior is at least {aggregate['low']:.2f} nats from the prior at the "
            "same state."
        )
        simulated = one["simulated_information"]
        if simulated is not None:
            low, high = simulated["low"], simulated["high"]
            begin = f"between {low['mean']:.2f} and" if low else "(no lower bound: the guide reads the pushes) at most"
            sentences.append(
                f"In windows that the model generates, {symbol} carries {begin} {high['mean']:.2f} nats, given all "
                "before it."
            )
        if one["aggregate_kl"] is not None:
            sentences.append(
                f"KL(aggregate posterior of {symbol} | prior) is at most {max(one['aggregate_kl']['high'], 0.0):.2f} "
                "nats."
            )
    return sentences


def _table(values: dict[str, Any], codes: tuple[str, ...]) -> Table:
    header = [
        "code",
        "dimensions",
        "active",
        "E KL(q | p)",
        "information given the state, at most",
        "aggregate KL given the state, at least",
        "information with the state, at least",
        "at most",
        "marginal aggregate KL, at most",
        "in generated windows, at least",
        "at most ",
    ]
    rows = []
    for name in codes:
        one = values[name]
        between, marginal, simulated = one["information"] or {}, one["aggregate_kl"], one["simulated_information"] or {}
        rows.append(
            [
                SYMBOLS[name],
                one["dimensions"],
                one["active"],
                one["kl"]["mean"],
                one["information_given_state"]["high"],
                one["aggregate_kl_given_state"]["low"],
                between.get("lower"),
                between.get("upper"),
                marginal["high"] if marginal else None,
                *((simulated.get(end) or {}).get("mean") for end in ("low", "high")),
            ]
        )
    return Table(header, rows, digits=2)


def _picture(values: dict[str, Any], codes: tuple[str, ...]) -> Picture:
    caption = (
        "Per dimension: how much the posterior mean varies over windows (above the dashed line a dimension is active), "
        "and how many nats it costs. Nothing is shown below where the guide or the prior is no diagonal Gaussian."
    )
    return Picture("codes", caption, draw_dimensions(values, codes))
