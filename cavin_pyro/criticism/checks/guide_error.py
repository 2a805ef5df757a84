"""The guide's distance from the posterior: bounds on the evidence, and tails of the importance weights."""

from __future__ import annotations

import math

from torch import Tensor

from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.figures.guide_error import draw_guide_error
from cavin_pyro.criticism.section import Picture, Section, Table
from cavin_pyro.criticism.statistics.clusters import mean_interval, mean_with_error
from cavin_pyro.criticism.statistics.codes import effect_log_weights, log_weights, sample_guide, without_codes
from cavin_pyro.criticism.statistics.inference.importance import Weights
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.criticism.verdicts.verdict import Verdict, conclude, grade

NAME, TITLE = "guide_error", "How far the guide is from the posterior"
FEW_TAILS, MANY_TAILS = 0.2, 0.5  # shares of windows with a k-hat above the limit
LABELS = {
    "joint": "all codes: the guide for the posterior",
    "effect_code": "c alone: q(c) for p(c | s, s', a)",
    "effect_code_given_subgoal": "c without the actions: q(c) for p(c | s, s')",
    "motion_code": "z alone: q(z|c) for p(z | s, a, c), c fixed",
}


def assess_guide_error(
    context: CheckContext,
    *,
    windows: int = 200,
    particles: tuple[int, ...] = (1, 10, 100, 1000),
    inner_windows: int = 50,
    inner_particles: int = 8,
) -> Section:
    """Bounds of K particles and Pareto k-hat on validation windows; for a cascade the codes apart as well.

    The weights, with c, z sampled from the guide, and f's terms (which no code changes) as a constant factor:

    - joint: p(c) h(s'|s,c) p(z) g(a|s,c,z) / (q(c) q(z|c)), the target is p(c, z | s, s', a).
    - effect_code: p(c) h(s'|s,c) r(c) / q(c), where r(c) is the mean of p(z) g(a|s,c,z) / q(z|c) over
      `inner_particles` samples of z: an unbiased estimate of p(a|s,c), so the target is p(c | s, s', a). What r(c)
      lacks in precision makes the gap and k-hat of c too large, never too small on average.
    - effect_code_given_subgoal: p(c) h(s'|s,c) / q(c), the target is p(c | s, s'): all that a guide can aim at that
      does not see the actions.
    - motion_code: p(z) g(a|s,c,z) / q(z|c) with c fixed to one sample, the target is p(z | s, a, c).

    The first is the chain of the second and the fourth: KL(q(c,z) | p) = KL(q(c) | p) + E KL(q(z|c) | p).

    Args:
        windows: held-out windows for all targets but effect_code, at most.
        particles: values of K; 1 gives the ELBO, the largest is the number of samples.
        inner_windows: of these windows, those for effect_code.
        inner_particles: samples of the motion code for each sample of the effect code, in r(c).
    """
    if not context.codes:
        return without_codes(NAME, TITLE)
    model, guide = context.model, context.guide
    window, episodes = context.held_out(windows)
    few, inner_episodes = context.held_out(inner_windows)
    samples = max(particles)
    with seeded(context.seed):
        logs = {"joint": log_weights(model, guide, window, samples)}
        if len(context.codes) > 1:
            logs["effect_code"] = effect_log_weights(model, guide, few, samples, inner=inner_particles)
            later = ("motion_code", "actions")
            logs["effect_code_given_subgoal"] = log_weights(model, guide, window, samples, excluded=later)
            fixed = {"effect_code": sample_guide(guide, window, 1)["effect_code"][0]}
            logs["motion_code"] = log_weights(model, guide, window, samples, fixed=fixed)
    found = {
        name: Weights.of(log, particles, inner_episodes if name == "effect_code" else episodes)
        for name, log in logs.items()
    }
    text, findings, values = _explanation(found), _findings(found), _values(found)
    return Section(NAME, TITLE, text, findings, values, [_table(found)], [_picture(found)], _verdict(found["joint"]))


def _explanation(found: dict[str, Weights]) -> str:
    joint = found["joint"]
    samples, count = max(joint.bounds), len(joint.shapes)
    text = (
        "The ELBO falls short of log p(observed) by KL(guide | posterior). The bound of K particles, one logarithm for "
        "each window, comes nearer to it as K grows, so its rise from K = 1 is a lower bound on that shortfall. k-hat "
        f"is the shape of the tail of the {samples} importance weights of a window: above {joint.limit:.2f}, the limit "
        "for so many (min(1 - 1 / log10 S, 0.7), Vehtari and others), the guide "
        f"misses parts of the posterior that matter. {count} validation windows."
    )
    if "effect_code" in found:
        text += f" For c alone z is summed out by inner samples, on {len(found['effect_code'].shapes)} windows."
    return text


def _findings(found: dict[str, Weights]) -> list[str]:
    sentences = []
    for name, weights in found.items():
        gap, share = mean_with_error(weights.gap, weights.episodes), mean_interval(weights.unreliable, weights.episodes)
        sentences.append(
            f"{LABELS[name]}: at least {gap['mean']:.2f} ± {gap['standard_error']:.2f} nats short; k-hat is above "
            f"{weights.limit:.2f} for {share.mean:.0%} of the windows ({max(share.low, 0):.0%} to "
            f"{min(share.high, 1):.0%})."
        )
    return sentences


def _verdict(joint: Weights) -> Verdict:
    share = mean_interval(joint.unreliable, joint.episodes)
    rule = (
        f"The share of windows whose k-hat is above {joint.limit:.2f}, all codes together: good if its 95 % interval "
        f"over episodes ends below {FEW_TAILS:.0%}, bad if it begins above {MANY_TAILS:.0%}."
    )
    advice = "Do not importance-sample from this guide; the amortization section tells whether its network fails."
    level = grade(share.low, share.high, good=FEW_TAILS, bad=MANY_TAILS)
    return conclude(level, rule, advice, windows=len(joint.shapes), episodes=joint.episodes)


def _values(found: dict[str, Weights]) -> dict[str, object]:
    values: dict[str, object] = {}
    for name, weights in found.items():
        base = weights.bounds[min(weights.bounds)]
        values[name] = {
            "windows": len(weights.shapes),
            "bounds": {str(K): mean_with_error(bound, weights.episodes) for K, bound in weights.bounds.items()},
            "rises": {str(K): mean_with_error(bound - base, weights.episodes) for K, bound in weights.bounds.items()},
            "pareto_k": {
                **{key: _shown(weights.shapes, part) for key, part in (("p5", 0.05), ("median", 0.5), ("p95", 0.95))},
                "limit": weights.limit,
                "above_limit": weights.unreliable.mean().item(),
            },
        }
    return values


def _shown(shapes: Tensor, part: float) -> float | None:
    """A quantile of k-hat, None where it is not finite: report.json has no infinity."""
    value = shapes.quantile(part, interpolation="nearest").item()
    return value if math.isfinite(value) else None


def _table(found: dict[str, Weights]) -> Table:
    Ks = list(found["joint"].bounds)
    header = [
        "proposal and target",
        *(f"rise at K = {K}" for K in Ks if K > 1),
        "k-hat, median",
        "share above its limit",
    ]
    rows = []
    for name, weights in found.items():
        rises = [(weights.bounds[K] - weights.bounds[min(Ks)]).mean().item() for K in Ks if K > 1]
        share = weights.unreliable.mean().item()
        rows.append([LABELS[name], *rises, _shown(weights.shapes, 0.5), share])
    return Table(header, rows, digits=2)


def _picture(found: dict[str, Weights]) -> Picture:
    caption = (
        "Left: how far the bound rises above the ELBO with more particles (two standard errors); a guide that equals "
        "the posterior stays at zero. Right: the share of windows whose k-hat is smaller; right of the dashed line "
        "importance weights cannot repair the guide."
    )
    return Picture("guide_error", caption, draw_guide_error(found, LABELS))
