"""`check export=FILE`: samples that ArviZ reads and plots."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.estimates import arviz
from cavin_pyro.criticism.export import check_export, sample_groups, write_samples
from models.networks.pointnet import PointNet
from models.state import State, Window

ABOUT = {"checkpoint": "run/checkpoint.safetensors", "weights": "0123", "model": "CascadedModel", "guide": None}


@pytest.fixture(scope="module")
def context(small: SimpleNamespace) -> CheckContext:
    """Windows of 2 and 3 objects, of random numbers, and an untrained cascade."""
    parts = small.parts()
    generator = torch.Generator().manual_seed(4)
    mask = (torch.arange(3) < torch.tensor([2, 3, 3, 2])[:, None, None]).expand(4, 4, 3)
    states = State(
        torch.rand(4, 4, 3, 3, generator=generator), torch.randn(4, 4, 3, 64, generator=generator), mask.clone()
    )
    states.mask[1, -1, 0] = False  # gone after the last push
    actions = torch.rand(4, 3, 4, generator=generator)
    window = Window(states, actions, torch.ones(4, 3, dtype=torch.bool), torch.ones(4, dtype=torch.bool))
    programs = [parts[name].requires_grad_(False).eval() for name in ("model", "guide")]
    return CheckContext(*programs, PointNet(), window, window)


@pytest.fixture(scope="module")
def file(context: CheckContext, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("export") / "samples.nc"
    write_samples(context, path, ABOUT, windows=4, samples=30)
    return path


def test_groups_dimensions_units_and_values_are_those_of_the_windows(file: Path, context: CheckContext) -> None:
    data = arviz().from_netcdf(file)
    assert set(data.groups()) == {
        *("posterior", "prior", "posterior_predictive", "prior_predictive"),
        *("observed_data", "sample_stats", "constant_data"),
    }
    assert dict(data.posterior["effect_code"].sizes) == {"chain": 1, "draw": 30, "window": 4, "effect_dimension": 4}
    centers = data.posterior_predictive["next_centers"]
    assert centers.dims == ("chain", "draw", "window", "push", "object", "axis")
    assert (centers.attrs["units"], list(centers["axis"].values)) == ("metres", ["x", "y", "z"])
    assert list(centers["push"].values) == [1, 2, 3]
    assert data.observed_data["actions"].dims == ("window", "push", "parameter")
    assert data.attrs["model"] == "CascadedModel" and "guide" not in data.attrs
    # Windows are in an order of their own; padding is NaN.
    mask, actions = context.validation.states.mask.numpy(), context.validation.actions.numpy()
    order, wanted = (np.argsort(one[:, 0, 0]) for one in (data.observed_data["actions"].values, actions))
    assert np.array_equal(data.observed_data["actions"].values[order], actions[wanted])
    goals = data.observed_data["subgoal_centers"].values[order]
    assert np.array_equal(np.isnan(goals[..., 0]), ~mask[:, -1][wanted])
    predicted = data.prior_predictive["next_centers"].values[0][:, order]
    assert np.array_equal(np.isnan(predicted[..., 0]).all((0, 2)), ~mask[:, 0][wanted])
    assert np.isfinite(data.sample_stats["log_weight"].values).all()


def test_posterior_predictions_follow_the_codes_of_the_posterior(context: CheckContext) -> None:
    """Actions lie around g's mean for the exported codes, as far as their likelihood says."""
    groups = sample_groups(context, windows=4, samples=200)
    codes = groups["posterior"]["motion_code"]
    assert codes.shape == (1, 200, 4, 4) and not torch.equal(codes, groups["prior"]["motion_code"])
    model = context.model
    order = torch.randperm(4, generator=torch.Generator().manual_seed(context.seed))  # as `some_windows` has it
    means = model.actions(
        context.validation.first.scene(order).expand((200, 4)),
        effect_code=groups["posterior"]["effect_code"][0],
        motion_code=codes[0],
    )
    residuals = groups["posterior_predictive"]["actions"][0] - means
    starts, motions = residuals[..., :2].std(), residuals[..., 2:].std()
    assert float(starts) == pytest.approx(0.077, rel=0.05) and float(motions) == pytest.approx(0.245, rel=0.05)


def test_a_bad_file_is_one_line_and_nothing_is_left_of_one_that_cannot_be_written(
    context: CheckContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert check_export(None) is None
    with pytest.raises(UserError, match=r"^export=samples.json must name a netCDF file: give it the ending .nc$"):
        check_export("samples.json")
    (tmp_path / "file").touch()
    with pytest.raises(UserError, match="cannot be written"):
        check_export(str(tmp_path / "file" / "samples.nc"))

    def full(*arguments: Any, **options: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arviz().InferenceData, "to_netcdf", full)
    with pytest.raises(OSError, match="No space left"):
        write_samples(context, tmp_path / "samples.nc", ABOUT, windows=2, samples=2)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
