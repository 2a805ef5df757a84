"""What the probabilities of an evaluation's plans amount to, for people and for `results.json`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from cavin_pyro.evaluation.success.calibration import Calibration, Interval, calibration
from cavin_pyro.evaluation.success.probability import Probability, Unfitted


def calibration_of(rows: Sequence[Mapping[str, Any]]) -> Calibration | None:
    """Of the episodes whose plans have probabilities; None if there are none."""
    known = [row for row in rows if row.get("success_probability")]
    if not known:
        return None
    return calibration([row["success_probability"] for row in known], [row["outcome"] == "success" for row in known])


def sentence(found: Calibration | None, probability: Probability) -> str:
    """One line about an evaluation; empty where no plan is given a probability and none could be."""
    if isinstance(probability, Unfitted):
        return uncalibrated(probability)
    if found is None:
        return ""
    rate = found.successes / found.episodes
    base = f", {found.base:.3f} for the base rate" if 0 < found.successes < found.episodes else ""
    return (
        f"predicted success {100 * (rate + found.bias.value):.1f} %, {100 * rate:.1f} % of {found.episodes} episodes "
        f"succeeded; calibration error {bounds(found.error)}, Brier score {found.brier:.3f}{base}"
    )


def sentence_of_episode(row: Mapping[str, Any], probability: Probability) -> str:
    """One line about one episode; empty where no plan is given a probability and none could be."""
    if isinstance(probability, Unfitted):
        return uncalibrated(probability)
    told = row["success_probability"]
    if not told:
        return ""
    return f"predicted success {100 * told[0]:.0f} % at the start, {100 * told[-1]:.0f} % at the end"


def uncalibrated(probability: Unfitted) -> str:
    """One line about why plans have no probability."""
    return f"probability of success: uncalibrated, {probability.why}" if probability.why else ""


def bounds(interval: Interval) -> str:
    """An estimate and its bounds: "0.031 (0.000 to 0.064)"."""
    return f"{interval.value:.3f} ({interval.low:.3f} to {interval.high:.3f})"


def record(found: Calibration | None) -> dict[str, Any] | None:
    """For `results.json`."""
    if found is None:
        return None
    plain = found._asdict()
    bins = {name: [round(float(one), 4) for one in plain.pop(name)] for name in ("predicted", "observed", "weight")}
    plain |= {name: value._asdict() for name, value in plain.items() if isinstance(value, Interval)}
    return {**plain, "bins": bins}
