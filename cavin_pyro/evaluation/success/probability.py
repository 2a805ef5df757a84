"""P(success of the episode | plan): logistic regressions, one for each planner that was fitted, in one file."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.evaluation.success.configuration import Scenes, planner_mismatch, situation
from cavin_pyro.evaluation.success.predictors import PredictorValues
from cavin_pyro.evaluation.success.regressors import REGRESSORS
from cavin_pyro.storage.files import read_json

FORMAT = "cavin_pyro success probability"
LARGEST = 10_000_000  # bytes of a file
SHIPPED = Path(__file__).with_name("fitted.json")


@dataclass(frozen=True)
class Regression:
    """The logistic regression of one planner.

    Attributes:
        name: of the planner, for people. planner, checkpoint, scenes: what it was fitted for.
        intercept, slopes: of the log odds; a slope is per unit of its regressor.
        lowest, highest: of the log odds in the fit; probabilities beyond are not extrapolated.
        episodes, successes, plans: in the fit.
    """

    name: str
    planner: dict[str, Any]
    checkpoint: str
    scenes: tuple[Scenes, ...]
    intercept: float
    slopes: dict[str, float]
    lowest: float
    highest: float
    episodes: int
    successes: int
    plans: int

    def __call__(self, plans: Sequence[PredictorValues]) -> float | None:
        """P(success | the last of an episode's plans so far); None if it does not tell what the fit needs."""
        odds = self.intercept + sum(slope * REGRESSORS[name].value(plans) for name, slope in self.slopes.items())
        if not math.isfinite(odds):
            return None
        return 1.0 / (1.0 + math.exp(-min(max(odds, self.lowest), self.highest)))


@dataclass(frozen=True)
class Unfitted:
    """There is no regression for a configuration. why: in words; empty for a planner that predicts nothing."""

    why: str

    def __call__(self, plans: Sequence[PredictorValues]) -> None:
        """No number is better than a wrong one."""
        return None


Probability = Regression | Unfitted
NO_PROBABILITY = Unfitted("")


def probability_for(config: DictConfig) -> Probability:
    """The regression for a configuration of `plan` or `evaluate`, from `success_probability` or the shipped file.

    Raises:
        UserError: the file is damaged.
    """
    if "horizon" not in config.planner:
        return NO_PROBABILITY
    path = SHIPPED if config.success_probability is None else Path(config.success_probability)
    now, nearest = situation(config), ""
    fewest = (True, math.inf)  # a fit for such scenes is nearer than any for others
    for one in read_regressions(path):
        differing = planner_mismatch(one.planner, now.planner)
        if one.checkpoint != now.checkpoint:
            differing.append("checkpoint")
        outside = [scenes.mismatch(now.scenes) for scenes in one.scenes]
        if not differing and None in outside:
            return one
        said = [f"{name}={_value(name, now.planner, config)}" for name in differing]
        if all(outside):
            said.append(min(filter(None, outside), key=_far))
        if (far := (all(outside), len(said))) < fewest:
            fewest, nearest = far, " and ".join(said[:2])
    return Unfitted(f"not fitted for {nearest}" if nearest else f"{path} holds no fit")


def _value(name: str, options: Mapping[str, Any], config: DictConfig) -> Any:
    """An option as the user gave it; of one with options of its own, such as an optimizer, its class."""
    return options.get(name, options.get(f"{name}._target_", config.get(name)))


def read_regressions(path: Path) -> list[Regression]:
    """The regressions in a file.

    Raises:
        UserError: there is no such file, or it is damaged.
    """
    if not path.is_file() or path.stat().st_size > LARGEST:
        raise UserError(f"success_probability={path} is no file of up to {LARGEST:,} bytes: fit one, or leave it out")
    content = read_json(path)
    try:
        if content["format"] != FORMAT:
            raise ValueError("another format")
        return [_regression(one) for one in content["regressions"]]
    except (KeyError, TypeError, ValueError, AttributeError) as error:
        raise UserError(
            f"success_probability={path} is no file of benchmarks/success_probability.py, or damaged ({error}): "
            "fit it again"
        ) from error


def _regression(plain: dict[str, Any]) -> Regression:
    slopes = {str(name): float(value) for name, value in plain["slopes"].items()}
    if unknown := sorted(set(slopes) - set(REGRESSORS)):
        raise ValueError(f"unknown regressor {unknown[0]!r}")
    intercept, lowest, highest = (float(plain[name]) for name in ("intercept", "lowest", "highest"))
    if not all(map(math.isfinite, (intercept, lowest, highest, *slopes.values()))):
        raise ValueError("a number is not finite")
    scenes = tuple(
        Scenes(dict(one["equal"]), {name: (int(low), int(high)) for name, (low, high) in one["ranges"].items()})
        for one in plain["scenes"]
    )
    return Regression(
        name=str(plain["name"]),
        planner=dict(plain["planner"]),
        checkpoint=str(plain["checkpoint"]),
        scenes=scenes,
        intercept=intercept,
        slopes=slopes,
        lowest=lowest,
        highest=highest,
        **{name: int(plain[name]) for name in ("episodes", "successes", "plans")},
    )


def _far(mismatch: str) -> int:
    """Another task is farther than another layout, and that than a number outside a range."""
    return 2 if mismatch.startswith("task.") else 1 if mismatch.startswith(("layout", "tiles")) else 0
