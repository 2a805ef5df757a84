"""Samples of a model and its guide as ArviZ's DataTree, a netCDF file with a group for each kind of samples.

    posterior              codes of the guide: effect_code, motion_code
    prior                  the same codes from the prior at the first state
    posterior_predictive   what the model generates with codes of the guide: subgoal_centers, actions, next_centers
    prior_predictive       the same with codes of the prior
    observed_data          the same, as observed
    sample_stats           log_weight: log p(observed, codes) / q(codes), to reweight the posterior (Pareto smoothing)
    constant_data          first_centers and mask, which generation reads

Dimensions: `chain` (one), `draw`, `window`, `object`, `push`, `axis`, `parameter` (of a push), `effect_dimension`,
`motion_dimension`. Centres are metres; padding is NaN. Features are left out, because they are twenty times the rest.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch
from pyro.infer import Predictive
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.statistics.codes import log_weights
from cavin_pyro.criticism.statistics.windows import seeded
from cavin_pyro.storage.files import atomic_write

if TYPE_CHECKING:
    from xarray import Dataset

PACKAGES = ("xarray", "h5netcdf")  # the extra `export`
SAMPLES = ("chain", "draw", "window")
DIMENSIONS: dict[str, tuple[str, ...]] = {  # of each variable, after its samples
    "effect_code": ("effect_dimension",),
    "motion_code": ("motion_dimension",),
    "subgoal_centers": ("object", "axis"),
    "actions": ("push", "parameter"),
    "next_centers": ("push", "object", "axis"),
    "first_centers": ("object", "axis"),
    "mask": ("object",),
    "log_weight": (),
}
NAMES = {"axis": ["x", "y", "z"], "parameter": ["x", "y", "dx", "dy"]}
PREDICTED = ("subgoal_centers", "actions", "next_centers")
UNITS = dict.fromkeys(("subgoal_centers", "next_centers", "first_centers"), "metres") | {
    "actions": "normalised",
    "log_weight": "nats",
}


def check_export(file: str | None) -> Path | None:
    """The option `export`, before anything is computed.

    Raises:
        UserError: not a .nc file, a folder that cannot be made, or a package that is not installed.
    """
    if file is None:
        return None
    path = Path(file)
    if path.suffix != ".nc" or path.is_dir():
        raise UserError(f"export={file} must name a netCDF file: give it the ending .nc")
    try:
        for package in PACKAGES:
            importlib.import_module(package)
    except ImportError as error:
        raise UserError(
            f"export= needs an optional part that is not installed ({error}): "
            "python -m pip install --constraint constraints.txt '.[export]'"
        ) from error
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise UserError(f"export={file} cannot be written ({error.strerror}): choose another file") from error
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
    from xarray import DataTree

    told = {name: str(about[name]) for name in ("checkpoint", "weights", "model", "guide", "prior") if about.get(name)}
    root = {**told, "seed": context.seed, "inference_library": "pyro", "creation_library": "cavin_pyro"}
    groups = sample_groups(context, windows=windows, samples=samples)
    tree = DataTree.from_dict({name: dataset(values) for name, values in groups.items()})
    tree.attrs.update(root)
    with atomic_write(path) as temporary:
        tree.to_netcdf(temporary, engine="h5netcdf")


@torch.no_grad()
def sample_groups(context: CheckContext, *, windows: int, samples: int) -> dict[str, dict[str, Tensor]]:
    """Variables by group: `[1, S, B, ...]` for S samples of the windows `[B]`, `[B, ...]` for observations."""
    model, guide = context.model, context.guide
    window, _ = context.held_out(windows)
    real, after = window.states.mask, window.states.step(slice(1, None))
    options = {"num_samples": samples, "parallel": True}
    groups: dict[str, dict[str, Tensor]] = {}
    with seeded(context.seed):
        generated = Predictive(model, **options)(window, generate=True)
        groups["prior"] = {name: generated[name] for name in context.codes}
        groups["prior_predictive"] = predictions(generated, window.first.mask)
        if context.codes:
            codes = Predictive(guide, return_sites=context.codes, **options)(window)
            generated = Predictive(model, posterior_samples=codes, parallel=True)(window, generate=True)
            groups["posterior"] = codes
            groups["posterior_predictive"] = predictions(generated, window.first.mask)
            groups["sample_stats"] = {"log_weight": log_weights(model, guide, window, samples, fixed=codes)}
    groups = {name: {key: value.unsqueeze(0) for key, value in group.items()} for name, group in groups.items()}
    observed = {"subgoal_centers": window.last.centers, "actions": window.actions, "next_centers": after.centers}
    kept = {name: observed[name] for name in groups["prior_predictive"]}
    groups["observed_data"] = predictions(kept, real[:, -1], real[:, 1:])
    first = without_padding(window.first.centers, window.first.mask)
    groups["constant_data"] = {"first_centers": first, "mask": window.first.mask}
    return {name: group for name, group in groups.items() if group}


def predictions(values: Mapping[str, Tensor], mask: Tensor, steps: Tensor | None = None) -> dict[str, Tensor]:
    """The predicted variables among `values`; `mask: [B, M]`, `steps: [B, T, M]` for each push where that varies."""
    every = mask.unsqueeze(-2) if steps is None else steps
    found = {name: values[name] for name in PREDICTED if name in values}
    masks = {"subgoal_centers": mask, "next_centers": every}
    return {name: without_padding(value, masks[name]) if name in masks else value for name, value in found.items()}


def without_padding(centers: Tensor, mask: Tensor) -> Tensor:
    """NaN in the place of padding: `centers: [..., M, 3]`, `mask: [..., M]`."""
    return centers.where(mask.unsqueeze(-1), float("nan"))


def dataset(values: Mapping[str, Tensor]) -> Dataset:
    """Variables with the names of their dimensions, coordinates and units."""
    from xarray import Dataset

    variables: dict[str, Any] = {}
    sizes: dict[str, int] = {}
    for name, value in values.items():
        own = DIMENSIONS[name]
        dims = (*SAMPLES[3 - (value.dim() - len(own)) :], *own)
        variables[name] = (dims, value.cpu().numpy(), {"units": UNITS[name]} if name in UNITS else {})
        sizes |= dict(zip(dims, value.shape, strict=True))
    coords = {name: NAMES.get(name, [*range(name == "push", size + (name == "push"))]) for name, size in sizes.items()}
    return Dataset(variables, coords=coords)
