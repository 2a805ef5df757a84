"""Fits the logistic regressions of `probability` to the rows of finished evaluations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.special import expit

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.rows import Row, finished_episodes
from cavin_pyro.evaluation.success.configuration import Situation, joined, situation_of
from cavin_pyro.evaluation.success.predictors import PredictorValues, plans_of
from cavin_pyro.evaluation.success.probability import FORMAT, Regression
from cavin_pyro.evaluation.success.regressors import REGRESSORS
from cavin_pyro.storage.files import write_json
from cavin_pyro.storage.run_directory import stored_options

RIDGE = 1.0  # see `logistic`
FEWEST = 10  # episodes of a fit
CONSTANT = 1e-9  # standard deviation of a regressor, against its size, that is rounding
Array = NDArray[np.float64]


class Evaluated(NamedTuple):
    """A finished evaluation whose rows hold success predictors."""

    situation: Situation
    rows: list[Row]


def read_evaluation(folder: Path) -> Evaluated:
    """A folder of `evaluate`.

    Raises:
        UserError: it holds no evaluation, a damaged one, or one whose planner predicts nothing.
    """
    if not (folder / "config.yaml").is_file():
        raise UserError(f"{folder} holds no evaluation: give folders of evaluate")
    rows = list(finished_episodes(folder / "episodes.jsonl").values())
    if not rows or any(row.get("success_predictors") is None for row in rows):
        raise UserError(
            f"{folder} holds no success predictors of plans: evaluate it again, with a planner that predicts"
        )
    return Evaluated(situation_of(stored_options(folder / "config.yaml")), rows)


def by_planner(evaluations: Sequence[Evaluated]) -> list[list[Evaluated]]:
    """The evaluations of each planner."""
    groups: list[list[Evaluated]] = []
    for one in evaluations:
        key = one.situation.planner, one.situation.checkpoint
        same = next((all_ for all_ in groups if (all_[0].situation.planner, all_[0].situation.checkpoint) == key), None)
        if same is None:
            groups.append([one])
        else:
            same.append(one)
    return groups


def fit(evaluations: Sequence[Evaluated], name: str, *, ridge: float = RIDGE) -> Regression:
    """The regression of one planner from its evaluations. Every episode counts as much as any other.

    Raises:
        UserError: there are too few episodes.
    """
    rows = [row for one in evaluations for row in one.rows]
    ends = np.array([row["outcome"] == "success" for row in rows])
    if len(ends) < FEWEST:
        raise UserError(f"{len(ends)} episodes of {name} are too few for a fit: evaluate at least {FEWEST}")
    episodes = [regressors_of(plans_of(row["success_predictors"])) for row in rows]
    names = [one for number, one in enumerate(REGRESSORS) if all(np.isfinite(x[:, number]).all() for x in episodes)]
    kept = [list(REGRESSORS).index(one) for one in names]
    x = np.concatenate([one[:, kept] for one in episodes])
    y = np.concatenate([np.full(len(one), float(end)) for one, end in zip(episodes, ends, strict=True)])
    weights = np.concatenate([np.full(len(one), 1.0 / len(one)) for one in episodes])
    intercept, slopes = logistic(x, y, weights, ridge, [REGRESSORS[one].sign for one in names])
    odds = intercept + x @ slopes
    situation = evaluations[0].situation
    return Regression(
        name=name,
        planner=situation.planner,
        checkpoint=situation.checkpoint,
        scenes=tuple(joined([one.situation.scenes for one in evaluations])),
        intercept=intercept,
        slopes={one: float(slope) for one, slope in zip(names, slopes, strict=True)},
        lowest=float(odds.min()),
        highest=float(odds.max()),
        episodes=len(rows),
        successes=int(ends.sum()),
        plans=len(x),
    )


def regressors_of(plans: Sequence[PredictorValues]) -> Array:
    """The regressors of every plan of an episode: [plans, regressors]; NaN for what its planner does not know."""
    sofar = [plans[: number + 1] for number in range(len(plans))]
    return np.array([[regressor.value(some) for regressor in REGRESSORS.values()] for some in sofar], dtype=np.float64)


def logistic(
    x: Array, y: Array, weights: Array, ridge: float, signs: Sequence[int] | None = None
) -> tuple[float, Array]:
    """Intercept and slopes [d] of the log odds, by weighted maximum likelihood with a ridge penalty.

    The penalty is half of `ridge` times the squared slopes per standard deviation of their regressors: a normal prior
    with variance 1 / ridge. The intercept, at the mean regressors, has Jeffreys' prior of a rate: as if half an
    observation more had succeeded and half a one failed. So no probability is 0 or 1, even if all outcomes are alike.

    Args:
        x: [n, d]. y: [n] in {0, 1}. weights: [n], whose sum is the number of independent observations.
        signs: 1 or -1 for each regressor whose slope must not have the other sign; 0 or None: either.
    """
    mean = np.average(x, axis=0, weights=weights)
    scale = np.sqrt(np.average((x - mean) ** 2, axis=0, weights=weights))
    scale = np.where(scale > CONSTANT * (1.0 + np.abs(mean)), scale, math.inf)  # a constant has no slope
    z = (x - mean) / scale

    def loss(parameters: Array) -> tuple[float, Array]:
        intercept, slopes = parameters[0], parameters[1:]
        odds = intercept + z @ slopes
        value = weights @ (np.logaddexp(0.0, odds) - y * odds) + 0.5 * ridge * slopes @ slopes
        value += 0.5 * (np.logaddexp(0.0, intercept) + np.logaddexp(0.0, -intercept))
        off = weights * (expit(odds) - y)
        return float(value), np.concatenate([[off.sum() + expit(intercept) - 0.5], off @ z + ridge * slopes])

    either = (-np.inf, np.inf)
    slopes_within = [(either, (0.0, np.inf), (-np.inf, 0.0))[sign] for sign in signs or [0] * x.shape[1]]
    found = minimize(
        loss,
        np.zeros(1 + x.shape[1]),
        jac=True,
        method="L-BFGS-B",
        bounds=[either, *slopes_within],
        options={"ftol": 1e-12, "gtol": 1e-8},
    )
    slopes = found.x[1:] / scale
    return float(found.x[0] - slopes @ mean), slopes


def write_regressions(path: Path, regressions: Sequence[Regression], about: Mapping[str, Any]) -> None:
    """Write the file that `probability_for` reads, atomically. about: its provenance, JSON-ready."""
    write_json(path, {"format": FORMAT, **about, "regressions": [asdict(one) for one in regressions]})
