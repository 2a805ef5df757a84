"""What the table says: rates with intervals, and paired tests with Holm's correction."""

from __future__ import annotations

from typing import Any

import pandas as pd
from statsmodels.stats.multitest import multipletests

from cavin_pyro.evaluation.statistics import hierarchical_interval, mcnemar, wilson
from cavin_pyro.reproduction.methods import METHODS
from cavin_pyro.reproduction.table import CELL, CRITERIA

TEST = ["criterion", "in_paper", "scenes", "reference_alone", "other_alone", "p"]
REFERENCE = "cavin"  # which the others are compared with


def rates(table: pd.DataFrame) -> pd.DataFrame:
    """A row for every cell and criterion: episodes, outcomes, and two intervals of the rate of success.

    `low` and `high` are Wilson's at 95 %, as if all episodes were of one model; `seed_low` and `seed_high` are of the
    bootstrap that samples training seeds first and their episodes then.
    """
    found: list[dict[str, Any]] = []
    for cell, own in table.groupby(CELL, sort=False):
        for criterion in CRITERIA:
            outcomes = own[f"{criterion}_outcome"]
            success = outcomes == "success"
            low, high = hierarchical_interval(success.to_numpy(bool), own["training_seed"].to_numpy())
            found.append(
                {
                    **dict(zip(CELL, cell, strict=True)),
                    "criterion": criterion,
                    "episodes": len(own),
                    "successes": int(success.sum()),
                    **wilson(int(success.sum()), len(own)),
                    "seed_low": low,
                    "seed_high": high,
                    **{name: float((outcomes == name).mean()) for name in ("violation", "fall", "timeout")},
                }
            )
    return pd.DataFrame(found)


def paired_tests(table: pd.DataFrame) -> pd.DataFrame:
    """CAVIN against every other method with the same kind of planner: exact McNemar tests, episode by episode.

    `p_holm`: with Holm's correction. A family is all comparisons of one kind of planner and one criterion, with methods
    of the paper or with others, so that what the paper has is corrected as if no others were there.
    """
    found: list[tuple[Any, ...]] = []
    cells = dict(iter(table.groupby(CELL, sort=False)))
    for (method, *rest), other in cells.items():
        reference = cells.get((REFERENCE, *rest))
        if method == REFERENCE or reference is None:
            continue
        scenes = reference.merge(other, on=["training_seed", "seed"], suffixes=("", "_other"))
        for criterion in CRITERIA:
            ours, theirs = (scenes[f"{criterion}_outcome{side}"] == "success" for side in ("", "_other"))
            alone, other_alone = int((ours & ~theirs).sum()), int((theirs & ~ours).sum())
            found.append(
                (method, *rest, criterion, METHODS[method].in_paper)
                + (len(scenes), alone, other_alone, mcnemar(alone, other_alone))
            )
    tests = pd.DataFrame(found, columns=[*CELL, *TEST])
    families = tests.groupby(["planner", "criterion", "in_paper"])["p"]
    return tests.assign(p_holm=families.transform(lambda p_values: multipletests(p_values, method="holm")[1]))
