"""Scores of predictions given as samples: PIT, coverage of central intervals, CRPS, errors.

Gneiting, Balabdaoui and Raftery, "Probabilistic forecasts, calibration and sharpness", 2007. Samples, because that
suits every likelihood, also a user's own and mixtures over codes.
"""

from __future__ import annotations

from typing import Any

import torch
from pyro.ops.stats import crps_empirical, energy_score_empirical
from torch import Tensor

LEVELS = (0.5, 0.8, 0.9, 0.95)  # of central intervals


def probability_integral_transform(samples: Tensor, observed: Tensor) -> Tensor:
    """Where `observed: [...]` lies among `samples: [S, ...]`, in [0, 1]: uniform for a prediction that is right.

    The rank is randomised within its step, so that uniform means exactly uniform for any S.
    """
    below, equal = (samples < observed).sum(0), (samples == observed).sum(0)
    return (below + torch.rand(observed.shape) * (equal + 1)) / (len(samples) + 1)


def coverage(transform: Tensor, level: float) -> float:
    """Share of the observed values, by their PIT `[N]`, that the central interval of a level holds."""
    return ((transform - 0.5).abs() <= level / 2).double().mean().item()


def scores(samples: Tensor, observed: Tensor, transform: Tensor) -> dict[str, Any]:
    """How well `samples: [S, N]` predict `observed: [N]`, whose PIT is `transform: [N]`.

    Returns:
        count: N. rms_error: of the samples' mean, which is the scale that would be right for a Gaussian with this
        mean. scale: root of the samples' mean variance, the scale that the model states. coverage: of each level,
        by its percentage. crps: mean, in the units of `observed`. All but count are NaN for N = 0.
    """
    if len(observed) == 0:
        nothing = float("nan")
        blank = dict.fromkeys(map(percentage, LEVELS), nothing)
        return {"count": 0, "rms_error": nothing, "scale": nothing, "coverage": blank, "crps": nothing}
    error = observed - samples.mean(0)
    return {
        "count": len(observed),
        "rms_error": error.square().mean().sqrt().item(),
        "scale": samples.var(0).mean().sqrt().item(),
        "coverage": {percentage(level): coverage(transform, level) for level in LEVELS},
        "crps": crps_empirical(samples, observed).mean().item(),
    }


def percentage(level: float) -> str:
    """A level as a key of report.json."""
    return f"{100 * level:.0f}"


def energy_score(samples: Tensor, observed: Tensor, mask: Tensor) -> Tensor:
    """The CRPS of all real centres of a window at once, in metres: `[B]`; a single guess scores its distance.

    Args:
        samples: `[S, B, M, 3]`. observed: `[B, M, 3]`. mask: `[B, M]`.
    """
    real = mask.unsqueeze(-1)
    predicted = (samples * real).flatten(2).transpose(0, 1)
    return energy_score_empirical(predicted, (observed * real).flatten(1))
