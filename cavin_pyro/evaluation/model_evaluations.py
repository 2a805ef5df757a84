"""How often a plan evaluates its model, in rows of states and codes (or pushes) passed to h, g, f and the priors."""

from __future__ import annotations

from collections import Counter
from typing import Any

import torch
from omegaconf import DictConfig, OmegaConf
from torch import Tensor

from cavin_pyro.data.observed import observed_state
from cavin_pyro.evaluation.factory import make_runner
from envs.randomness import planner_seed
from models.state import State

PARTS = {
    "subgoal": "h",
    "actions": "g",
    "next_state": "f",
    "effect_prior": "effect_prior",
    "motion_prior": "motion_prior",
}


class CountingModel:
    """A model that counts the rows of every call in `rows`, by the names in `PARTS`; everything else is the model's."""

    def __init__(self, model: Any) -> None:
        self._model = model
        self.rows = Counter(dict.fromkeys(PARTS.values(), 0))

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._model, name)
        if name not in PARTS:
            return found

        def counted(*arguments: State | Tensor, **named: State | Tensor) -> Any:
            shapes = [
                one.batch_shape if isinstance(one, State) else one.shape[:-1] for one in (*arguments, *named.values())
            ]
            self.rows[PARTS[name]] += torch.broadcast_shapes(*shapes).numel()
            return found(*arguments, **named)

        return counted


def count_evaluations(config: DictConfig) -> dict[str, int]:
    """The rows of the first plan of the scene `config.seed`, by part of the model; `config` is one of `evaluate`.

    A row is one state with one code or push: a plan of T pushes evaluates T rows of f. Later plans may need fewer or
    more, because searches stop early. Compiled planners evaluate as many rows as eager ones, so `planner.compile` is
    ignored. All are zero for a planner without a model.

    Raises:
        UserError: as `cavin_pyro.evaluation.factory.make_runner`.
    """
    eager = config.copy()
    if "compile" in eager.planner:
        OmegaConf.update(eager, "planner.compile", False)
    models: list[CountingModel] = []

    def counting(model: Any) -> CountingModel:
        models.append(CountingModel(model))
        return models[-1]

    runner = make_runner(eager, wrap=counting)
    try:
        observation, _ = runner.env.reset(seed=config.seed)
        generator = torch.Generator().manual_seed(planner_seed(config.seed))
        runner.planner.plan(observed_state(observation, runner.geometry, runner.device), [generator])
    finally:
        runner.env.close()
    return dict(models[0].rows) if models else dict.fromkeys(PARTS.values(), 0)
