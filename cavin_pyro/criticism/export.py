"""Samples of a model and its guide for ArviZ: a netCDF file with a group for each kind of samples.

docs/how-to/check-a-model.md lists the groups. Centres are metres, and padding is NaN. Features are left out, because
they are twenty times the rest.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import torch
from pyro.infer import Predictive
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.codes import log_weights
from cavin_pyro.criticism.estimates import arviz
from cavin_pyro.criticism.loading import CheckContext
from cavin_pyro.criticism.windows import all_pushes, seeded
from cavin_pyro.envs.tabletop.workspace import SPACE
from cavin_pyro.storage.files import atomic_write

DIMENSIONS = {  # of each variable, after chain and draw
    "effect_code": ["window", "effect_dimension"],
    "motion_code": ["window", "motion_dimension"],
    "subgoal_centers": ["window", "object", "axis"],
    "actions": ["window", "push", "parameter"],
    "next_centers": ["window", "push", "object", "axis"],
    "first_centers": ["window", "object", "axis"],
    "mask": ["window", "object"],
    "log_weight": ["window"],
}
AXES = {"axis": ["x", "y", "z"], "parameter": ["x", "y", "dx", "dy"]}  # of the table
PREDICTED = ("subgoal_centers", "actions", "next_centers")
UNITS = dict.fromkeys(("subgoal_centers", "next_centers", "first_centers"), "metres") | {
    "actions": "normalised",
    "log_weight": "nats",
}


def check_export(file: str | None) -> Path | None:
    """The option `export`, before anything is computed.

    Raises UserError: not a .nc file. OSError: its folder cannot be made.
    """
    if file is None:
        return None
    path = Path(file)
    if path.suffix != ".nc" or path.is_dir():
        raise UserError(f"export={file} must name a netCDF file: give it the ending .nc")
    path.parent.mkdir(parents=True, exist_ok=True)
    return path


def write_samples(
    context: CheckContext, path: Path, about: Mapping[str, Any], *, windows: int = 100, samples: int = 200
) -> None:
    """Write the file, atomically.

    Args:
        about: what the report says of the checkpoint.
        windows: held-out windows, at most.
        samples: samples of prior and guide for each window.
    """
    groups = sample_groups(context, windows=windows, samples=samples)
    told = {name: str(about[name]) for name in ("checkpoint", "weights", "model", "guide", "prior") if about.get(name)}
    pushes = len(groups["observed_data"]["next_centers"][0])
    data = arviz().from_dict(
        **{group: {name: value.numpy() for name, value in values.items()} for group, values in groups.items()},
        dims=DIMENSIONS,
        coords={**AXES, "push": list(range(1, pushes + 1))} if context.space == SPACE else {},
        attrs={**told, "seed": context.seed, "inference_library": "pyro", "creation_library": "cavin_pyro"},
    )
    for group in data.groups():
        for name, unit in UNITS.items():
            if name in data[group] and (unit != "metres" or context.space == SPACE):
                data[group][name].attrs["units"] = unit
    with atomic_write(path) as temporary:
        data.to_netcdf(str(temporary))


@torch.no_grad()
def sample_groups(context: CheckContext, *, windows: int, samples: int) -> dict[str, dict[str, Tensor]]:
    """Variables by group: `[1, S, B, ...]` for S samples of the windows `[B]`, `[B, ...]` for observations."""
    model, guide = context.model, context.guide
    window, _ = context.held_out(windows)
    real, after = window.states.mask, window.states.step(slice(1, None))
    options = {"num_samples": samples, "parallel": True}
    groups: dict[str, dict[str, Tensor]] = {}
    with seeded(context.seed):
        generated = Predictive(model.generate, **options)(window)
        groups["prior"] = {name: generated[name] for name in context.codes}
        groups["prior_predictive"] = predictions(generated, real)
        if context.codes:
            codes = Predictive(guide, return_sites=context.codes, **options)(window)
            generated = Predictive(model.generate, posterior_samples=codes, parallel=True)(window)
            groups["posterior"] = codes
            groups["posterior_predictive"] = predictions(generated, real)
            groups["sample_stats"] = {"log_weight": log_weights(model, guide, window, samples, fixed=codes)}
    groups = {name: {key: value.unsqueeze(0) for key, value in group.items()} for name, group in groups.items()}
    observed = {"subgoal_centers": window.last.centers, "actions": window.actions, "next_centers": after.centers}
    kept = {name: observed[name] for name in groups["prior_predictive"]}
    groups["observed_data"] = predictions(kept, real)
    first = without_padding(window.first.centers, window.first.mask)
    groups["constant_data"] = {"first_centers": first, "mask": window.first.mask}
    return {name: group for name, group in groups.items() if group}


def predictions(values: Mapping[str, Tensor], mask: Tensor) -> dict[str, Tensor]:
    """The predicted variables among `values`; `mask: [B, T + 1, M]`, of the observed states."""
    if "next_centers" not in values:
        values = {**values, "next_centers": all_pushes(values, "next_centers")}
    masks = {"subgoal_centers": mask[:, -1], "next_centers": mask[:, 1:]}
    predicted = {name: values[name] for name in PREDICTED if name in values}
    return {name: without_padding(value, masks[name]) if name in masks else value for name, value in predicted.items()}


def without_padding(centers: Tensor, mask: Tensor) -> Tensor:
    """NaN in the place of padding: `centers: [..., M, 3]`, `mask: [..., M]`."""
    return centers.where(mask.unsqueeze(-1), float("nan"))
