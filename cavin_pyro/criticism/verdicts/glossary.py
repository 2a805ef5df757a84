"""The terms of a report, each in a sentence."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

GLOSSARY = {
    "s, s', a": "the state before a window's pushes, the state after them, and the pushes.",
    "c, z": "the effect code, which says what should change, and the motion code, which says how.",
    "f, g, h": "the networks of the model: the state after a push; the pushes for an effect and a motion; the state "
    "that an effect leads to (the subgoal).",
    "guide": "the network that infers codes from a window; an approximation of the posterior.",
    "prior": "the distribution from which a planner samples codes, given the observed state.",
    "posterior": "the distribution of the codes given a whole window, which the guide approximates.",
    "ELBO": "the evidence lower bound: what training maximises. log p(observed) less KL(guide | posterior).",
    "KL": "the Kullback-Leibler divergence of two distributions; 0 if they are equal.",
    "nat": "unit of information, 1.44 bits.",
    "k-hat": "shape of the tail of importance weights; above its limit the guide misses parts of the posterior.",
    "amortization gap": "what the ELBO gains if the guide is fitted to each window on its own.",
    "aggregate posterior": "the distribution of inferred codes over all windows.",
    "simulation-based calibration": "sample codes from the prior and windows from the program; the guide's "
    "intervals must cover the codes at their nominal rate.",
    "coverage": "how often an interval contains the truth: 90 % of the time for a correct 90 % interval.",
    "contraction": "the fraction by which the posterior reduces the prior's variance, given s.",
    "AUC": "area under the ROC curve of a classifier: the share of pairs (one code from the guide, one from the prior) "
    "that it orders correctly; 0.5 by chance.",
    "expected coverage": "TARP: the share of samples nearer to a reference point than the truth, which must be "
    "uniform.",
    "PIT": "where the truth lies among the samples of a prediction, from 0 to 1; uniform if the prediction is right.",
    "CRPS": "error of a prediction with its spread in one number, in the unit of the quantity; lower is better.",
    "energy score": "the CRPS of all centres at once.",
    "tail probability": "share of generated datasets with at least the observed value; near 0 or 1 is a misfit.",
    "95 % interval": "a confidence interval over episodes, not windows, because windows of one episode overlap.",
}


def glossary_of(parts: Iterable[Mapping[str, Any]]) -> list[tuple[str, str]]:
    """Terms and meanings, if there are sections to read."""
    return list(GLOSSARY.items()) if list(parts) else []
