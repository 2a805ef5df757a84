"""The objective of training, from the configuration."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from omegaconf import ListConfig

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.options import shown
from cavin_pyro.config.parts import Config, check_sizes, construct
from cavin_pyro.training.objectives import Objective, as_objective
from models.model import Model


def data_folders(data: str | Sequence[str]) -> list[Path]:
    """The option `data`: a folder, or a list of them.

    Raises:
        UserError: it is something else.
    """
    folders = [data] if isinstance(data, str) else data
    listed = isinstance(folders, Sequence | ListConfig) and all(isinstance(one, str) and one for one in folders)
    if not listed or not folders:
        raise UserError(f"data must be a dataset folder from collect, or a list of them, not {shown(data)!r}")
    return [Path(folder) for folder in folders]


def build_objective(config: Config, model: Model) -> Objective:
    """The objective, from the section `objective`.

    Raises:
        UserError: an objective that cannot be built, or that is incompatible with the model.
    """
    section = config["objective"]
    check_sizes("objective", {name: value for name, value in section.items() if name != "warm_up_steps"})
    if "elbo" in section and section["elbo"] is None:
        raise UserError("objective.elbo must be a section, not null")
    check_sizes("objective.elbo", section.get("elbo") or {})
    with user_input():
        objective = as_objective(construct(section))
        objective.check(model)
    return objective
