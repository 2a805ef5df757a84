"""How far the guide is from the posterior: bounds on the evidence and the tails of the importance weights."""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.importance import UNRELIABLE, evidence_bounds, pareto_shapes
from cavin_pyro.criticism.sampling import (
    draw_guide,
    log_weights,
    mean_with_error,
    seeded,
    some_windows,
    without_codes,
)
from cavin_pyro.criticism.section import Picture, Section, Subject, Table
from models.state import Window

NAME, TITLE = "guide_error", "How far the guide is from the posterior"
LABELS = {
    "joint": "all codes: the guide for the posterior",
    "effect_code": "c alone: q(c) for p(c | s, s', a)",
    "effect_code_given_subgoal": "c without the actions: q(c) for p(c | s, s')",
    "motion_code": "z alone: q(z|c) for p(z | s, a, c), c fixed",
}
COLORS = {
    "joint": "#000000",
    "effect_code": "#0072B2",
    "effect_code_given_subgoal": "#56B4E9",
    "motion_code": "#D55E00",
}


class Weights(NamedTuple):
    """What a proposal's log weights `[N, B]` come to."""

    bounds: dict[int, Tensor]  # by K, [B]
    shapes: Tensor  # k-hat [B]

    @property
    def gap(self) -> Tensor:
        """The largest bound minus the ELBO: `[B]` nats."""
        return self.bounds[max(self.bounds)] - self.bounds[min(self.bounds)]


def assess_guide_error(
    subject: Subject,
    *,
    windows: int = 200,
    particles: tuple[int, ...] = (1, 10, 100, 1000),
    inner_windows: int = 50,
    inner_particles: int = 8,
) -> Section:
    """Bounds of K particles and Pareto k-hat on validation windows; for a cascade the codes apart as well.

    The weights, with c, z drawn from the guide, and f's terms (which no code changes) as a constant factor:

    - joint: p(c) h(s'|s,c) p(z) g(a|s,c,z) / (q(c) q(z|c)), the target is p(c, z | s, s', a).
    - effect_code: p(c) h(s'|s,c) r(c) / q(c), where r(c) is the mean of p(z) g(a|s,c,z) / q(z|c) over
      `inner_particles` draws of z: an unbiased estimate of p(a|s,c), so the target is p(c | s, s', a). What r(c) lacks
      in precision makes the gap and k-hat of c too large, never too small on average.
    - effect_code_given_subgoal: p(c) h(s'|s,c) / q(c), the target is p(c | s, s'): all that a guide can aim at that
      does not see the actions.
    - motion_code: p(z) g(a|s,c,z) / q(z|c) with c held at one draw, the target is p(z | s, a, c).

    The first is the chain of the second and the fourth: KL(q(c,z) | p) = KL(q(c) | p) + E KL(q(z|c) | p).

    Args:
        windows: used for all but effect_code, which has `inner_windows` of them.
        particles: values of K; 1 gives the ELBO, the largest is the number of draws.
    """
    if not subject.codes:
        return without_codes(NAME, TITLE)
    model, guide = subject.model, subject.guide
    window = some_windows(subject.validation, windows, subject.seed)
    draws = max(particles)
    with seeded(subject.seed):
        logs = {"joint": log_weights(model, guide, window, draws)}
        if len(subject.codes) > 1:
            few = some_windows(subject.validation, inner_windows, subject.seed)
            logs["effect_code"] = _without_motion(subject, few, draws, inner_particles)
            later = ("motion_code", "actions")
            logs["effect_code_given_subgoal"] = log_weights(model, guide, window, draws, without=later)
            held = {"effect_code": draw_guide(guide, window, 1)["effect_code"][0]}
            logs["motion_code"] = log_weights(model, guide, window, draws, held=held)
    found = {name: Weights(evidence_bounds(log, particles), pareto_shapes(log)) for name, log in logs.items()}
    return Section(NAME, TITLE, _explanation(found), _findings(found), _values(found), [_table(found)], [_draw(found)])


def _without_motion(subject: Subject, window: Window, draws: int, inner: int) -> Tensor:
    """Log weights `[draws, B]` of c, with z summed out by `inner` draws for each c."""
    model, guide = subject.model, subject.guide
    effect = draw_guide(guide, window, draws)["effect_code"]
    every = log_weights(
        model, guide, window, draws * inner, held={"effect_code": effect.repeat_interleave(inner, dim=0)}
    )
    return every.unflatten(0, (draws, inner)).logsumexp(1) - math.log(inner)


def _explanation(found: dict[str, Weights]) -> str:
    joint = found["joint"]
    draws, count = max(joint.bounds), len(joint.shapes)
    text = (
        "The ELBO falls short of log p(observed) by KL(guide | posterior). The bound of K particles, one logarithm for "
        "each window, comes nearer to it as K grows, so its rise from K = 1 is a lower bound on that shortfall. k-hat "
        f"is the shape of the tail of the {draws} importance weights of a window: above {UNRELIABLE} the guide misses "
        f"parts of the posterior that matter. {count} validation windows."
    )
    if "effect_code" in found:
        text += f" For c alone z is summed out by inner draws, on {len(found['effect_code'].shapes)} windows."
    return text


def _findings(found: dict[str, Weights]) -> list[str]:
    sentences = []
    for name, weights in found.items():
        gap, share = mean_with_error(weights.gap), (weights.shapes > UNRELIABLE).double().mean().item()
        sentences.append(
            f"{LABELS[name]}: at least {gap['mean']:.2f} ± {gap['standard_error']:.2f} nats short; k-hat is above "
            f"{UNRELIABLE} for {share:.0%} of the windows."
        )
    return sentences


def _values(found: dict[str, Weights]) -> dict[str, object]:
    values: dict[str, object] = {}
    for name, weights in found.items():
        base = weights.bounds[min(weights.bounds)]
        values[name] = {
            "windows": len(weights.shapes),
            "bounds": {str(K): mean_with_error(bound) for K, bound in weights.bounds.items()},
            "rises": {str(K): mean_with_error(bound - base) for K, bound in weights.bounds.items()},
            "pareto_k": {
                **{key: _shown(weights.shapes, part) for key, part in (("p5", 0.05), ("median", 0.5), ("p95", 0.95))},
                "above_0.5": (weights.shapes > 0.5).double().mean().item(),
                "above_0.7": (weights.shapes > UNRELIABLE).double().mean().item(),
            },
        }
    return values


def _shown(shapes: Tensor, part: float) -> float | None:
    """A quantile of k-hat, None where it is not finite: report.json has no infinity."""
    value = shapes.quantile(part, interpolation="nearest").item()
    return value if math.isfinite(value) else None


def _table(found: dict[str, Weights]) -> Table:
    Ks = list(found["joint"].bounds)
    header = ["proposal and target", *(f"rise at K = {K}" for K in Ks if K > 1), "k-hat, median", "share above 0.7"]
    rows = []
    for name, weights in found.items():
        rises = [(weights.bounds[K] - weights.bounds[min(Ks)]).mean().item() for K in Ks if K > 1]
        share = (weights.shapes > UNRELIABLE).double().mean().item()
        rows.append([LABELS[name], *rises, _shown(weights.shapes, 0.5), share])
    return Table(header, rows, digits=2)


def _draw(found: dict[str, Weights]) -> Picture:
    figure = Figure(figsize=(10.0, 3.6), layout="constrained")
    rises, tails = figure.subplots(1, 2)
    for name, weights in found.items():
        base = weights.bounds[min(weights.bounds)]
        errors = [mean_with_error(bound - base) for bound in weights.bounds.values()]
        heights, bars = [error["mean"] for error in errors], [2 * error["standard_error"] for error in errors]
        rises.errorbar(list(weights.bounds), heights, bars, color=COLORS[name], marker="o", label=LABELS[name])
        # A line, not bars: where several cumulative shares lie above one another, all stay visible.
        ordered = weights.shapes.clamp(-0.5, 2.0).sort().values
        tails.plot(
            ordered, torch.arange(1, len(ordered) + 1) / len(ordered), color=COLORS[name], drawstyle="steps-post"
        )
    rises.set(xscale="log", xlabel="particles K", ylabel="bound minus ELBO (nats)")
    tails.axvline(UNRELIABLE, color="#9A9A9A", linestyle="--", linewidth=1.0)
    tails.set(xlabel="k-hat (cut off at -0.5 and 2)", ylabel="share of windows below", xlim=(-0.55, 2.05), ylim=(0, 1))
    figure.legend(*rises.get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8, frameon=False)
    for panel in (rises, tails):
        panel.grid(color="#DDDDDD", linewidth=0.6)
        panel.spines[["top", "right"]].set_visible(False)
    caption = (
        "Left: how far the bound rises above the ELBO with more particles (two standard errors); a guide that equals "
        "the posterior stays at zero. Right: the share of windows whose k-hat is smaller; right of the dashed line "
        "importance weights cannot repair the guide."
    )
    return Picture("guide_error", caption, figure)
