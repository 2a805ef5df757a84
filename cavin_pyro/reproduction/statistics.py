"""What the table says: rates with intervals, paired tests with Holm's correction, interquartile means."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.stats import trim_mean

from cavin_pyro.evaluation.statistics import mcnemar, wilson
from cavin_pyro.reproduction.cells import FIGURES
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.table import CRITERIA, Row

RESAMPLES = 10_000
CELL = ("method", "planner", "task", "reward", "objects")
OURS = "cavin"


def by_cell(rows: Sequence[Row]) -> dict[tuple[Any, ...], list[Row]]:
    """Rows by method, planner, task, reward and number of objects, in the order of the table."""
    found: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        found.setdefault(tuple(row[name] for name in CELL), []).append(row)
    return found


def rates(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Of every cell and criterion: episodes, outcomes, and two intervals of the rate of success.

    `low` and `high` are Wilson's at 95 %, as if all episodes were of one model; `seed_low` and `seed_high` are of the
    bootstrap that samples training seeds first and their episodes then.
    """
    found = []
    for cell, own in by_cell(rows).items():
        for criterion in CRITERIA:
            outcomes = [row[f"{criterion}_outcome"] for row in own]
            success = [outcome == "success" for outcome in outcomes]
            low, high = hierarchical_interval(success, [row["training_seed"] for row in own])
            found.append(
                {
                    **dict(zip(CELL, cell, strict=True)),
                    "criterion": criterion,
                    "episodes": len(own),
                    **wilson(sum(success), len(own)),
                    "seed_low": low,
                    "seed_high": high,
                    **{name: outcomes.count(name) / len(own) for name in ("violation", "fall", "timeout")},
                    "unsafe": float(np.mean([row["unsafe"] for row in own])),
                    "steps": float(np.mean([row[f"{criterion}_steps"] for row in own])),
                    "return": float(np.mean([row[f"{criterion}_return"] for row in own])),
                }
            )
    return found


def hierarchical_interval(success: Sequence[bool], groups: Sequence[int], seed: int = 0) -> tuple[float, float]:
    """95 % interval of a rate by the bootstrap over groups, and over the episodes in each of them.

    Episodes of a group, sampled with replacement, succeed as often as a binomial variable says.
    """
    generator = np.random.default_rng(seed)
    values = [
        np.array([one for one, group in zip(success, groups, strict=True) if group == name])
        for name in sorted(set(groups))
    ]
    counts, means = np.array([len(one) for one in values]), np.array([one.mean() for one in values])
    chosen = generator.integers(len(values), size=(RESAMPLES, len(values)))
    rates = (generator.binomial(counts[chosen], means[chosen]) / counts[chosen]).mean(1)
    low, high = np.quantile(rates, (0.025, 0.975))
    return float(low), float(high)


def paired_tests(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Exact McNemar tests, episode by episode, with Holm's p values.

    CAVIN against every other method, both with the same kind of planner; and every variant against `paper` of the same
    method. A family is all comparisons of one kind of planner (all variants together) and one criterion, with methods
    of the paper or with others, so that what the paper has is corrected as if no others were there.
    """
    cells, found = by_cell(rows), []
    for criterion in CRITERIA:
        families: dict[tuple[str, bool], list[dict[str, Any]]] = {}
        for cell, others in cells.items():
            method, planner, *rest = cell
            reference = (OURS, planner) if planner in FIGURES else (method, "paper")
            against = cells.get((*reference, *rest))
            if reference != (method, planner) and against is not None:
                kind = planner if planner in FIGURES else "variants"
                family = families.setdefault((kind, METHODS[method].in_paper), [])
                compared = {
                    **dict(zip(CELL, cell, strict=True)),
                    "criterion": criterion,
                    "against": "-".join(reference),
                }
                family.append(compared | _paired(against, others, criterion))
        for _, family in sorted(families.items()):
            for entry, corrected in zip(family, holm([entry["p"] for entry in family]), strict=True):
                found.append({**entry, "p_holm": corrected})
    return found


def _paired(reference: Sequence[Row], others: Sequence[Row], criterion: str) -> dict[str, Any]:
    """The comparison of two cells on the scenes that both have; `difference`: reference minus other."""
    one, other = (_successes(part, criterion) for part in (reference, others))
    common = sorted(set(one) & set(other))
    alone = sum(one[scene] and not other[scene] for scene in common)
    other_alone = sum(other[scene] and not one[scene] for scene in common)
    return {
        "scenes": len(common),
        "difference": sum(one[s] - other[s] for s in common) / len(common) if common else 0.0,
        "reference_alone": alone,
        "other_alone": other_alone,
        "p": mcnemar(alone, other_alone),
    }


def holm(p_values: Sequence[float]) -> list[float]:
    """Holm's step-down correction for a family of tests: the probability of any false one stays below the level."""
    order = np.argsort(p_values, kind="stable")
    corrected, highest = [0.0] * len(p_values), 0.0
    for rank, number in enumerate(order):
        highest = max(highest, min(1.0, (len(p_values) - rank) * p_values[number]))
        corrected[number] = highest
    return corrected


def interquartile_means(rows: Sequence[Row]) -> list[dict[str, Any]]:
    """Over tasks and training seeds, of every method, planner, reward, number of objects and criterion.

    The mean of the middle half of the scores (Agarwal et al., NeurIPS 2021), a score being a training seed's rate of
    success in a task.
    """
    groups: dict[tuple[Any, ...], dict[tuple[Any, ...], list[Row]]] = {}
    for row in rows:
        key = tuple(row[name] for name in ("method", "planner", "reward", "objects"))
        groups.setdefault(key, {}).setdefault((row["task"], row["training_seed"]), []).append(row)
    found = []
    for key, runs in groups.items():
        for criterion in CRITERIA:
            scores = [np.mean([row[f"{criterion}_outcome"] == "success" for row in run]) for run in runs.values()]
            found.append(
                {
                    **dict(zip(("method", "planner", "reward", "objects"), key, strict=True)),
                    "criterion": criterion,
                    "runs": len(scores),
                    "interquartile_mean": float(trim_mean(scores, 0.25)),
                }
            )
    return found


def _successes(rows: Sequence[Mapping[str, Any]], criterion: str) -> dict[tuple[int, int], bool]:
    return {(row["training_seed"], row["seed"]): row[f"{criterion}_outcome"] == "success" for row in rows}
