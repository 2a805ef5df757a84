"""The objective of training, from the configuration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from cavin_pyro.config.errors import user_input
from cavin_pyro.config.parts import Config, check_sizes, construct
from cavin_pyro.training.objectives import Objective, as_objective
from models.model import Model


def data_folders(data: str | Sequence[str]) -> list[Path]:
    """The option `data`: a folder, or a list of them."""
    return [Path(folder) for folder in ([data] if isinstance(data, str) else data)]


def build_objective(config: Config, model: Model) -> Objective:
    """The objective, from the section `objective`.

    Raises:
        UserError: an objective that cannot be built, or that is incompatible with the model.
    """
    section = config["objective"]
    check_sizes("objective", {name: value for name, value in section.items() if name != "warm_up_steps"})
    check_sizes("objective.elbo", section.get("elbo") or {})
    with user_input():
        objective = as_objective(construct(section))
        objective.check(model)
    return objective
