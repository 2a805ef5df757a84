"""How far from their subgoals pursuits end, in numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.criticism.pursuit import Pursuit

MOVING = 0.02  # metres; objects that a subgoal moves less are not counted among those that it wants moved
RESAMPLES = 1000  # of the scenes, for intervals

Floats = NDArray[np.floating]
Measures = dict[str, Any]


def measure(pursuits: Sequence[Pursuit], *, seed: int) -> Measures:
    """Numbers of pursuits whose codes were chosen in one way; metres, shares as fractions, NaN where nothing counts.

    Counted in distances are pursuits in which no object fell or hid. An object is *wanted* where the subgoal lies
    more than `MOVING` from it.

    Returns:
        `pursuits`; shares `unsafe` and `ineffective` of the pushes, `fallen` and `hidden` of the pursuits;
        of the wanted objects: `wanted` (their mean distance to the subgoal at first, the baseline where nothing
        moves), `from_subgoal` (at the end), `predicted_from_subgoal` (f's end state; h against f),
        `from_prediction` (at the end; f against physics), `relative` (`from_subgoal` over `wanted`, with `low` and
        `high`, a 95 % bootstrap over pursuits), `relative_if_carried_out` (where every push was), `progress` (part
        of the wanted way that was made, along it), `nearer` (share that ends nearer to the subgoal);
        `bystanders`: how far the others moved. `prediction`: of objects that moved more than `MOVING` or were
        predicted to, `moved`, `error` (f against physics) and their ratio `relative`.
    """
    pushes = sum(len(pursuit.choice.actions) for pursuit in pursuits)
    sound = [pursuit for pursuit in pursuits if not pursuit.fallen and not pursuit.hidden]
    numbers: Measures = {
        "pursuits": len(pursuits),
        "counted": len(sound),
        "unsafe": sum(pursuit.unsafe for pursuit in pursuits) / pushes,
        "ineffective": sum(pursuit.ineffective for pursuit in pursuits) / pushes,
        "fallen": float(np.mean([pursuit.fallen for pursuit in pursuits])),
        "hidden": float(np.mean([pursuit.hidden for pursuit in pursuits])),
    }
    shape = (len(sound), *pursuits[0].before.shape)
    before = np.reshape([pursuit.before for pursuit in sound], shape)
    reached = np.reshape([pursuit.reached for pursuit in sound], shape)
    predicted = np.reshape([pursuit.choice.predicted for pursuit in sound], shape)
    moved, foretold, error = _lengths(reached - before), _lengths(predicted - before), _lengths(reached - predicted)
    moving = np.maximum(moved, foretold) > MOVING
    numbers["prediction"] = {
        "moved": _mean(moved[moving]),
        "error": _mean(error[moving]),
        "relative": _ratio(error[moving].sum(), moved[moving].sum()),
    }
    if pursuits[0].choice.subgoal is None:
        return numbers
    subgoal = np.reshape([pursuit.choice.subgoal for pursuit in sound], shape)
    way = _lengths(subgoal - before)
    wanted = way > MOVING
    left = _lengths(reached - subgoal)
    carried_out = np.array([pursuit.unsafe == 0 for pursuit in sound], dtype=bool)
    numbers |= {
        "wanted": _mean(way[wanted]),
        "from_subgoal": _mean(left[wanted]),
        "predicted_from_subgoal": _mean(_lengths(predicted - subgoal)[wanted]),
        "from_prediction": _mean(error[wanted]),
        **_relative(left * wanted, way * wanted, seed),
        "relative_if_carried_out": _ratio((left * wanted)[carried_out].sum(), (way * wanted)[carried_out].sum()),
        "progress": _ratio(((reached - before) * (subgoal - before)).sum(-1)[wanted].sum(), (way[wanted] ** 2).sum()),
        "nearer": _mean((left < way)[wanted]),
        "bystanders": _mean(moved[~wanted]),
    }
    return numbers


def _lengths(vectors: Floats) -> Floats:
    return np.linalg.norm(vectors, axis=-1)


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else math.nan


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else math.nan


def _relative(left: Floats, way: Floats, seed: int) -> dict[str, float]:
    """The ratio of the sums of `left, way: [pursuits, M]`, with its interval."""
    left, way = left.sum(-1), way.sum(-1)
    draws = np.random.default_rng(seed).integers(max(1, len(left)), size=(RESAMPLES, len(left)))
    ratios = [_ratio(left[draw].sum(), way[draw].sum()) for draw in draws]
    low, high = np.percentile(ratios, [2.5, 97.5]) if np.isfinite(ratios).all() else (math.nan, math.nan)
    return {"relative": _ratio(left.sum(), way.sum()), "low": float(low), "high": float(high)}
