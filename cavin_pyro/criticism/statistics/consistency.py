"""How far from their subgoals rollouts end."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cavin_pyro.criticism.subgoal_rollout import SubgoalRollout

MOVING = 0.02  # metres; objects that a subgoal moves less are not counted among those that it wants moved
RESAMPLES = 1000  # of the scenes, for intervals

Floats = NDArray[np.floating]
Measures = dict[str, Any]


def measure(rollouts: Sequence[SubgoalRollout], *, seed: int) -> Measures:
    """Numbers of rollouts whose codes were chosen in one way; metres, shares as fractions, NaN where nothing counts.

    Counted in distances are rollouts in which no object fell or hid. An object is *wanted* where the subgoal lies
    more than `MOVING` from it.

    Returns:
        `rollouts`; shares `unsafe` and `ineffective` of the pushes, `fallen` and `hidden` of the rollouts;
        of the wanted objects: `wanted` (their mean distance to the subgoal at first, the baseline where nothing
        moves), `from_subgoal` (at the end), `predicted_from_subgoal` (f's end state; h against f),
        `expected_from_subgoal` (the mean over samples of f; only where plans have it),
        `from_prediction` (at the end; f against physics), `relative` (`from_subgoal` over `wanted`, with `low` and
        `high`, a 95 % bootstrap over rollouts), `relative_if_executed` (where every push was), `progress` (part
        of the wanted way that was made, along it), `nearer` (share that ends nearer to the subgoal);
        `bystanders`: how far the others moved. `prediction`: of objects that moved more than `MOVING` or were
        predicted to, `moved`, `error` (f against physics) and their ratio `relative`.
    """
    pushes = sum(len(rollout.plan.actions) for rollout in rollouts)
    finished = [rollout for rollout in rollouts if not rollout.fallen and not rollout.hidden]
    numbers: Measures = {
        "rollouts": len(rollouts),
        "counted": len(finished),
        "unsafe": sum(rollout.unsafe for rollout in rollouts) / pushes,
        "ineffective": sum(rollout.ineffective for rollout in rollouts) / pushes,
        "fallen": float(np.mean([rollout.fallen for rollout in rollouts])),
        "hidden": float(np.mean([rollout.hidden for rollout in rollouts])),
    }
    shape = (len(finished), *rollouts[0].before.shape)
    before = np.reshape([rollout.before for rollout in finished], shape)
    reached = np.reshape([rollout.reached for rollout in finished], shape)
    predicted = np.reshape([rollout.plan.predicted for rollout in finished], shape)
    moved, error = _lengths(reached - before), _lengths(reached - predicted)
    moving = np.maximum(moved, _lengths(predicted - before)) > MOVING
    numbers["prediction"] = {
        "moved": _mean(moved[moving]),
        "error": _mean(error[moving]),
        "relative": _ratio(error[moving].sum(), moved[moving].sum()),
    }
    if rollouts[0].plan.subgoal is None:
        return numbers
    subgoal = np.reshape([rollout.plan.subgoal for rollout in finished], shape)
    way = _lengths(subgoal - before)
    wanted = way > MOVING
    left = _lengths(reached - subgoal)
    executed = np.array([rollout.unsafe == 0 for rollout in finished], dtype=bool)
    numbers |= {
        "wanted": _mean(way[wanted]),
        "from_subgoal": _mean(left[wanted]),
        "predicted_from_subgoal": _mean(_lengths(predicted - subgoal)[wanted]),
        "from_prediction": _mean(error[wanted]),
        **_relative(left * wanted, way * wanted, seed),
        "relative_if_executed": _ratio((left * wanted)[executed].sum(), (way * wanted)[executed].sum()),
        "progress": _ratio(((reached - before) * (subgoal - before)).sum(-1)[wanted].sum(), (way[wanted] ** 2).sum()),
        "nearer": _mean((left < way)[wanted]),
        "bystanders": _mean(moved[~wanted]),
    }
    if rollouts[0].plan.expected is not None:
        expected = np.reshape([rollout.plan.expected for rollout in finished], shape[:2])
        numbers["expected_from_subgoal"] = _mean(expected[wanted])
    return numbers


def wanted_distances(rollouts: Sequence[SubgoalRollout], threshold: float) -> Floats:
    """[4, n] metres, one column per object whose subgoal lies farther than `threshold`, without falls and hidden ones.

    Rows: from the subgoal at first; at the end; of f's prediction; and from f's prediction at the end.
    """
    columns = []
    for rollout in rollouts:
        subgoal, predicted = rollout.plan.subgoal, rollout.plan.predicted
        if subgoal is None or rollout.fallen or rollout.hidden:
            continue
        pairs = [
            (rollout.before, subgoal),
            (rollout.reached, subgoal),
            (predicted, subgoal),
            (rollout.reached, predicted),
        ]
        distances = np.stack([np.linalg.norm(one - other, axis=-1) for one, other in pairs])
        columns.append(distances[:, distances[0] > threshold])
    return np.concatenate([np.empty((4, 0)), *columns], axis=1)


def _lengths(vectors: Floats) -> Floats:
    return np.linalg.norm(vectors, axis=-1)


def _mean(values: NDArray[Any]) -> float:
    return float(values.mean()) if values.size else math.nan


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole > 0 else math.nan


def _relative(left: Floats, way: Floats, seed: int) -> dict[str, float]:
    """The ratio of the sums of `left, way: [rollouts, M]`, with its interval."""
    left, way = left.sum(-1), way.sum(-1)
    resamples = np.random.default_rng(seed).integers(max(1, len(left)), size=(RESAMPLES, len(left)))
    ratios = [_ratio(left[rows].sum(), way[rows].sum()) for rows in resamples]
    low, high = np.percentile(ratios, [2.5, 97.5]) if np.isfinite(ratios).all() else (math.nan, math.nan)
    return {"relative": _ratio(left.sum(), way.sum()), "low": float(low), "high": float(high)}
