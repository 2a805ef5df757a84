"""Made-up evaluations, whose plans tell the truth about success."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from omegaconf import OmegaConf
from scipy.special import expit

from cavin_pyro.config.composition import compose
from cavin_pyro.evaluation.success.predictors import SUCCESS_PREDICTORS
from tests.cavin_pyro.evaluation.test_rows import ROW

INTERCEPT, PER_METRE, IF_REACHES = 1.0, -4.0, 1.5  # of the log odds; 60 pushes are left


def rows(count: int, *, seed: int = 0) -> list[dict[str, Any]]:
    """Episodes of one or two plans, whose probability of success only depends on the metres left and on `reaches`."""
    generator, found = np.random.default_rng(seed), []
    for number in range(count):
        plans = int(generator.integers(1, 3))
        distance, reaches = float(generator.uniform(0.0, 1.0)), int(generator.random() < 0.5)
        success = generator.random() < expit(INTERCEPT + PER_METRE * distance + IF_REACHES * reaches)
        columns: dict[str, list[Any]] = {name: [0.0] * plans for name in SUCCESS_PREDICTORS}
        columns |= {"distance": [distance] * plans, "reaches": [reaches] * plans, "pushes_left": [60] * plans}
        columns |= {name: [None] * plans for name in ("allowed_distance", "allowed_distance_after")}
        end = "success" if success else "timeout"
        found.append({**ROW, "seed": number, "outcome": end, "plans": plans, "success_predictors": columns})
    return found


def evaluation(folder: Path, count: int, *overrides: str, seed: int = 0) -> Path:
    """A folder of `evaluate` with such episodes."""
    folder.mkdir()
    (folder / "config.yaml").write_text(OmegaConf.to_yaml(compose("evaluate", *overrides), resolve=True))
    (folder / "episodes.jsonl").write_text("".join(f"{json.dumps(row)}\n" for row in rows(count, seed=seed)))
    return folder
