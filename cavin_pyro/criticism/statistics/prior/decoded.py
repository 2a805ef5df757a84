"""What codes from the guide and from the prior mean on the table, compared window by window."""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from cavin_pyro.criticism.statistics.clusters import Interval, mean_interval
from cavin_pyro.criticism.statistics.pushing import Nearness, pair_distances, path_distances, start_distances
from cavin_pyro.criticism.statistics.windows import Outcome

LABELS = {
    "first_push_near": "first push passes near an object, share",
    "pushes_near": "pushes that pass near an object, share",
    "overlap": "subgoals in which two objects overlap, share",
    "farthest_move": "farthest move of an object in the subgoal, m",
    "start_to_nearest": "from the first push's start to the nearest centre, m",
}


def decoded_statistics(outcome: Outcome, nearness: Nearness) -> dict[str, Tensor]:
    """Each of `LABELS` that the model has, for each window: `[B]`, NaN where there is none."""
    found: dict[str, Tensor] = {}
    if outcome.chosen:
        near = path_distances(outcome).amin(-1) < nearness.tool  # [B, T]
        found |= {"first_push_near": near[:, 0].double(), "pushes_near": near.double().mean(-1)}
        start = start_distances(outcome)[:, 0].amin(-1).double()
        found["start_to_nearest"] = start.masked_fill(start.isinf(), torch.nan)
    if outcome.subgoal is not None:
        real = outcome.first.mask
        closest = pair_distances(outcome.subgoal, real).amin((-2, -1))
        found["overlap"] = (closest < nearness.pair).double().masked_fill(real.sum(-1) < 2, torch.nan)
        found["farthest_move"] = ((outcome.subgoal - outcome.first.centers).norm(dim=-1) * real).amax(-1).double()
    return {name: found[name] for name in LABELS if name in found}


class Difference(NamedTuple):
    """One statistic of two sources, first minus second, by window."""

    first: Interval
    second: Interval
    difference: Interval  # paired by window, clustered by episode
    standardised: float  # the difference over the standard deviation of single windows (Cohen's d)


def compare_decoded(first: Tensor, second: Tensor, episodes: Tensor) -> Difference:
    """Values `[B]` of two sources in the same windows."""
    spread = (0.5 * (_variance(first) + _variance(second))) ** 0.5
    difference = mean_interval(first - second, episodes)
    standardised = difference.mean / spread if spread > 0 else 0.0
    return Difference(mean_interval(first, episodes), mean_interval(second, episodes), difference, standardised)


def _variance(values: Tensor) -> float:
    known = values[~values.isnan()]
    return known.var().item() if len(known) > 1 else 0.0
