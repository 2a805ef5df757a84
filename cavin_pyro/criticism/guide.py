"""Is the guide calibrated? Codes from the prior, windows from the program, codes from the guide.

Talts, Betancourt, Simpson, Vehtari and Gelman, "Validating Bayesian inference algorithms with simulation-based
calibration", 2018. On average, posterior intervals of a simulated window must cover its own code at their nominal rate.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import torch
from matplotlib.figure import Figure
from torch import Tensor

from cavin_pyro.criticism.codes import SYMBOLS, Codes, guide_density, log_weights, sample_guide, unsuitable_codes
from cavin_pyro.criticism.estimates import arviz, covered, draw_ranks, mean_interval, rank
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.section import Section, conclude, not_applicable, within, worst
from cavin_pyro.criticism.windows import all_pushes, sampled_values, seeded
from cavin_pyro.models.model import Model
from cavin_pyro.models.space import unit
from cavin_pyro.models.state import State, Window
from cavin_pyro.training.elbo import Program

INFORMED = 0.1  # a dimension counts as informed where its variance shrinks by more, given s
LEVEL = 0.9
EQUAL = 1e-3  # nats
PRIOR_SAMPLES = 32  # of each window, for its variance given s
GOOD, BAD = (0.86, 0.94), (0.80, 0.98)  # of the coverage of 90 % intervals
COLORS = {"effect_code": "#0072B2", "motion_code": "#D55E00"}
JOINT_COLOR = "#009E73"

EXPLANATION = (
    "Codes are sampled from the prior at the first states of {windows} held-out windows of {episodes} episodes, the "
    "program generates a window from each, and {samples} codes are sampled from the guide for each. If the guide "
    "were the posterior, its 90 % intervals would cover the true code in 90 % of the windows, whatever the model. "
    "The joint region has the codes at which the guide's density is highest. A dimension is informed where the "
    "posterior takes more than {informed:.0%} of the prior's variance, given s. On real windows, importance weights "
    "p(window, codes) / q(codes) tell how far the guide is from the posterior: above {limit:.2f}, k-hat of their "
    "tail says that the guide misses parts of the posterior that matter (Vehtari and others, 2024)."
)


@torch.no_grad()
def assess_guide(
    context: CheckContext, *, windows: int = 1000, samples: int = 100, weighted: int = 200, particles: int = 1000
) -> Section:
    """Ranks and coverage of the guide's intervals for codes sampled from the prior, and k-hat on real windows.

    Args:
        windows: held-out windows whose first states are used, at most.
        samples: samples of the guide for each generated window.
        weighted: held-out windows for importance weights, at most.
        particles: importance weights for each of these windows.
    """
    window, episodes = context.held_out(windows)
    if reason := unsuitable_codes(context, window):
        return not_applicable(reason)
    with seeded(context.seed):
        simulated = simulated_ranks(context.model, context.guide, window, samples=samples)
    joint = mean_interval((simulated.joint <= LEVEL).double(), episodes)
    codes = {name: code_coverage(simulated, name, episodes) for name in context.codes}
    weights = importance(context, weighted, particles)
    return Section(
        EXPLANATION.format(
            windows=len(episodes),
            episodes=len(episodes.unique()),
            samples=samples,
            informed=INFORMED,
            limit=weights["limit"],
        ),
        conclude(
            worst(
                within(one.low, one.high, good=GOOD, bad=BAD)
                for one in (joint, *(code["informed"] for code in codes.values()))
            ),
            "What 90 % regions cover, of all codes jointly and of the informed dimensions of each: good if the 95 % "
            f"interval over episodes lies within {GOOD[0]:.0%} to {GOOD[1]:.0%}, bad if it lies outside of "
            f"{BAD[0]:.0%} to {BAD[1]:.0%}.",
            "Too narrow: train longer, or with guide=joint or guide=flow.",
            episodes,
        ),
        [
            *(
                f"90 % intervals of {SYMBOLS.get(name, name)} cover {one['informed'].percent()} over the "
                f"{one['informed_dimensions']} informed dimensions of {one['dimensions']}."
                for name, one in codes.items()
            ),
            f"90 % regions of all codes cover {joint.percent()}.",
            f"On real windows k-hat is above {weights['limit']:.2f} for {weights['unreliable'].percent()} of the "
            f"windows, and {particles} importance samples are worth {weights['effective'].text(0)}.",
        ],
        {"windows": len(episodes), "samples": samples, "joint": joint, "codes": codes, "importance": weights},
        "coverage of 90 % regions of all codes",
        joint,
        figure=_figure(simulated),
        caption="Distribution of the true codes' ranks among the guide's samples, minus the uniform one: each informed "
        "dimension, and the joint rank by density with a pointwise 95 % band. Zero if the guide is the posterior; "
        "ranks heaped at the ends (rising, then falling) mean too narrow.",
    )


@torch.no_grad()
def simulate(model: Model, window: Window) -> tuple[Codes, Window]:
    """Codes `[B, D]` from the prior and windows from the program, from the first states of windows `[B]`.

    The last state is h's, which the guide reads, where the model has one; those between are f's.
    """
    values = sampled_values(model.generate, window)
    centers, features = all_pushes(values, "next_centers"), unit(all_pushes(values, "next_features"))
    if "subgoal_centers" in values:
        centers[:, -1], features[:, -1] = values["subgoal_centers"], values["subgoal_features"]
    first = window.first
    mask = first.mask.unsqueeze(1).expand(-1, centers.shape[1] + 1, -1)
    states = State(
        torch.cat((first.centers.unsqueeze(1), centers), 1), torch.cat((first.features.unsqueeze(1), features), 1), mask
    )
    seen = torch.ones_like(window.transition_mask)
    simulated = Window(states, values.get("actions", window.actions), seen, seen[:, 0].clone())
    return {name: values[name] for name in model.codes}, simulated


class SimulatedRanks(NamedTuple):
    """Of simulated windows `[B]`."""

    ranks: Codes  # by code, [B, D] in [0, 1]: uniform if the guide is the posterior
    joint: Tensor  # [B] in [0, 1]: share of the guide's samples of all codes that are more dense than the true codes
    contraction: Codes  # by code, [D]: 1 - variance of the posterior over that of the prior given s

    def informed(self, name: str) -> Tensor:
        """Ranks `[B, I]` of the informed dimensions of a code, of all if none is."""
        which = self.contraction[name] > INFORMED
        return self.ranks[name][:, which] if which.any() else self.ranks[name]


@torch.no_grad()
def simulated_ranks(model: Model, guide: Program, window: Window, *, samples: int) -> SimulatedRanks:
    """Where the true codes of windows simulated from those of `window: [B]` lie among `samples` of the guide."""
    codes, simulated = simulate(model, window)
    inferred = sample_guide(guide, simulated, samples)
    prior = sample_guide(model, simulated, PRIOR_SAMPLES)
    ranks = {name: rank(inferred[name], codes[name]) for name in codes}
    truth = {name: value.unsqueeze(0) for name, value in codes.items()}
    densities = [
        torch.stack([guide_density(guide, simulated, values, name) for name in codes]).sum(0)
        for values in (inferred, truth)
    ]
    joint = rank(-densities[0], -densities[1][0])
    contraction = {name: 1 - inferred[name].var(0).mean(0) / prior[name].var(0).mean(0) for name in codes}
    return SimulatedRanks(ranks, joint, contraction)


def code_coverage(simulated: SimulatedRanks, name: str, episodes: Tensor) -> dict[str, Any]:
    """What 90 % intervals of a code cover, for windows of `episodes: [B]`.

    Returns intervals over `all` dimensions and over the `informed` ones; `by_dimension`; `dimensions` and
    `informed_dimensions`; `contraction`.
    """
    inside = covered(simulated.ranks[name], LEVEL)
    return {
        "all": mean_interval(inside.mean(1), episodes),
        "informed": mean_interval(covered(simulated.informed(name), LEVEL).mean(1), episodes),
        "by_dimension": inside.mean(0).tolist(),
        "dimensions": inside.shape[1],
        "informed_dimensions": int((simulated.contraction[name] > INFORMED).sum()),
        "contraction": simulated.contraction[name].tolist(),
    }


def importance(context: CheckContext, windows: int, particles: int) -> dict[str, Any]:
    """Pareto-smoothed importance weights of the guide on real windows, by ArviZ.

    Returns `limit` of k-hat for so many particles; intervals of the share of windows that are `unreliable` (above it),
    and of the `effective` sample size.
    """
    window, episodes = context.held_out(windows)
    with seeded(context.seed):
        logs = log_weights(context.model, context.guide, window, particles)
    smoothed, shapes = arviz().psislw(logs.T.numpy())
    # Fewer samples need a lighter tail; ten or fewer are never enough.
    limit = max(0.0, min(1 - 1 / torch.tensor(float(particles)).log10().item(), 0.7)) if particles > 10 else 0.0
    weights = torch.from_numpy(smoothed).reshape(len(episodes), particles).softmax(-1)
    # Weights that are equal but for rounding have no tail, which ArviZ calls infinitely heavy.
    heavy = (torch.as_tensor(shapes).reshape(-1) > limit) & (logs.amax(0) - logs.amin(0) > EQUAL)
    return {
        "windows": len(episodes),
        "limit": limit,
        "unreliable": mean_interval(heavy.double(), episodes),
        "effective": mean_interval(1 / weights.square().sum(-1), episodes),
    }


def _figure(simulated: SimulatedRanks) -> Figure:
    figure = Figure(figsize=(6.5, 3.6), layout="constrained")
    panel = figure.subplots()
    for name in simulated.ranks:
        for number, ranks in enumerate(simulated.informed(name).T):
            draw_ranks(panel, ranks, SYMBOLS.get(name, name) if number == 0 else "_", COLORS.get(name, "#000000"))
    draw_ranks(panel, simulated.joint, "jointly", JOINT_COLOR, band=True)
    panel.set(xlim=(0, 1), xlabel="rank", ylabel="ECDF minus uniform")
    panel.legend(fontsize=8, frameon=False)
    return figure
