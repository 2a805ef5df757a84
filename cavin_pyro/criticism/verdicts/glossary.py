"""The words of a report, each in a sentence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

GLOSSARY = {
    "s, s', a": "the state before a window's pushes, the state after them, and the pushes.",
    "c, z": "the effect code, which says what shall happen, and the motion code, which says how.",
    "f, g, h": "the networks of the model: the state after a push; the pushes for an effect and a motion; the state "
    "that an effect leads to (the subgoal).",
    "guide": "the network that infers codes from a window; an approximation of the posterior.",
    "prior": "the distribution that a planner samples codes from, given the state that it sees.",
    "posterior": "the distribution of the codes given a whole window, which the guide approximates.",
    "ELBO": "the evidence lower bound: what training maximises. log p(observed) less KL(guide | posterior).",
    "KL": "the Kullback-Leibler divergence of two distributions; 0 if they are equal.",
    "nat": "unit of information, 1.44 bits.",
    "k-hat": "shape of the tail of importance weights; above its limit the guide misses parts of the posterior.",
    "amortization gap": "what the ELBO gains if the guide is fitted to each window on its own.",
    "aggregate posterior": "the distribution of inferred codes over all windows.",
    "simulation-based calibration": "codes are drawn from the prior and windows from the program; the guide's "
    "intervals must hold the codes as often as they say.",
    "coverage": "how often an interval holds the truth; 90 % of the time for a 90 % interval, if all is right.",
    "contraction": "the part of the prior's variance, given s, that the posterior takes away.",
    "told apart": "share of pairs (one code from the guide, one from the prior) that a classifier orders rightly; 0.5 "
    "by chance.",
    "expected coverage": "TARP: the share of samples nearer to a reference point than the truth, which must be "
    "uniform.",
    "PIT": "where the truth lies among the samples of a prediction, from 0 to 1; uniform if the prediction is right.",
    "CRPS": "error of a prediction with its spread in one number, in the unit of the quantity; lower is better.",
    "energy score": "the CRPS of all centres at once.",
    "tail probability": "share of generated datasets with at least the observed value; near 0 or 1 is a misfit.",
    "95 % interval": "where the value lies with 95 % confidence if other episodes had been seen: all intervals are "
    "over episodes, since windows of one episode overlap.",
}


def glossary_of(parts: Iterable[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Words and meanings, if there are sections to read."""
    return list(GLOSSARY.items()) if list(parts) else []
