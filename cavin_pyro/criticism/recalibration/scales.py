"""Calibration of the scales that f predicts, by held-out windows (split conformal prediction).

f's errors on windows that training did not see are larger than on those that its scales were fitted to. The scales of
objects within a push's reach are multiplied by one number, so that intervals cover what they should.
"""

from __future__ import annotations

from functools import partial
from typing import Any, Protocol, runtime_checkable

import torch
from scipy.stats import t as student
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.statistics.clusters import bootstrap_interval
from cavin_pyro.criticism.statistics.intervals import as_percent
from cavin_pyro.criticism.statistics.pushing import MOVED
from models.likelihoods import PredictedScales
from models.model import Model
from models.state import Window

LEVELS = (0.5, 0.8, 0.9, 0.95)
LEVEL = 0.9  # at which the intervals are made right


@runtime_checkable
class AdjustableScales(Protocol):
    """An f whose scales can be widened."""

    def widen(self, factor: float) -> None:
        """Multiply the scales of centres by `factor`."""


def check_scales(model: Model) -> None:
    """Refuse a model whose f predicts no scales, or none that can be widened.

    Raises:
        UserError: it does not.
    """
    if not (isinstance(model.scales, PredictedScales) and isinstance(model.dynamics, AdjustableScales)):
        raise UserError(
            "parts=[scales] calibrates scales that f predicts, and this model's cannot be widened: choose "
            "parts=[guide], or train with dynamics=contact scales=predicted"
        )


@torch.no_grad()
def calibrate_scales(model: Model, window: Window) -> float:
    """Widen f's scales of centres so that 90 % intervals of x and y cover 90 % of the objects that moved over 1 cm.

    The factor is the 90 % quantile of |error| / scale in `window: [B]`, which training must not have seen, over that of
    f's Student's t; Lei and others 2018, "Distribution-free predictive inference for regression".

    Returns:
        The factor.

    Raises:
        UserError: nothing moved.
    """
    ratio, moved, _ = _ratios(model, window)
    if not moved.any():
        raise UserError("no object moved in the held-out windows: collect more transitions")
    factor = float(ratio[moved].flatten().quantile(LEVEL)) / _half_width(model, LEVEL)
    assert isinstance(model.dynamics, AdjustableScales)  # see `check_scales`
    model.dynamics.widen(factor)
    return factor


@torch.no_grad()
def measure_scales(model: Model, window: Window, episodes: Tensor) -> dict[str, Any]:
    """Shares of objects within central intervals of x and y, by level, with 95 % intervals over `episodes: [B]`.

    Of those that moved over 1 cm, and of those that moved less; and what share of the latter is seen exactly where it
    was, which every interval around no motion holds.
    """
    ratio, moved, exact = _ratios(model, window)
    still = ~moved & ~ratio.isnan().any(-1)
    found: dict[str, Any] = {"exactly_still": float((exact & still).sum() / still.sum()), "moved": {}, "still": {}}
    for name, which in (("moved", moved), ("still", still)):
        count = which.double().flatten(1).sum(1)
        for level in LEVELS:
            inside = ((ratio <= _half_width(model, level)).double().mean(-1) * which).flatten(1).sum(1)
            share = bootstrap_interval(partial(_share, inside, count), episodes)
            found[name][f"{level:g}"] = share._asdict()
    return found


def scale_sentences(before: dict[str, Any], after: dict[str, Any], factor: float) -> list[str]:
    """Both measurements, side by side, for the terminal."""
    lines = [f"f's scales of centres are {factor:.3g} times what they were"]
    for name, what in (("moved", "that moved"), ("still", "that lay still")):
        shares = [", ".join(as_percent(one[name][f"{level:g}"]) for level in LEVELS) for one in (before, after)]
        levels = ", ".join(f"{level:.0%}" for level in LEVELS)
        lines.append(f"intervals of {levels} cover, of objects {what}, {shares[0]}; now {shares[1]}")
    lines.append(
        f"{after['exactly_still']:.0%} of the latter are seen exactly where they were, which any interval covers"
    )
    return lines


def _share(inside: Tensor, count: Tensor, weights: Tensor) -> Tensor:
    return (weights @ inside) / (weights @ count).clamp(min=1e-30)


def _ratios(model: Model, window: Window) -> tuple[Tensor, Tensor, Tensor]:
    """|error| over scale in x and y, `[B, T, M, 2]`, NaN for objects that do not count; and two masks `[B, T, M]`.

    Which moved over 1 cm, and which are seen exactly where they were.
    """
    before, after = window.states.step(slice(0, -1)), window.states.step(slice(1, None))
    encoded = model.encode(window) if model.dynamics.reads_encoding else None
    mean, scales = model.dynamics.outcome(before, encoded, window.actions)
    assert scales is not None
    counted = before.mask & after.mask & window.transition_mask.unsqueeze(-1)
    ratio = (after.centers - mean.centers)[..., :2].abs() / scales[..., :1]
    motion = (after.centers - before.centers).norm(dim=-1)
    return ratio.masked_fill(~counted.unsqueeze(-1), torch.nan), counted & (motion > MOVED), counted & (motion == 0)


def _half_width(model: Model, level: float) -> float:
    """Of a central interval of x or y, in scales."""
    assert isinstance(model.scales, PredictedScales)
    return float(student.ppf(0.5 + level / 2, model.scales.degrees_of_freedom))
