"""`check export=FILE`: samples that ArviZ reads and plots."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.estimates import arviz
from cavin_pyro.criticism.export import check_export, sample_groups, write_samples
from cavin_pyro.criticism.loading import CheckContext

ABOUT = {"checkpoint": "run/checkpoint.safetensors", "weights": "0123", "model": "CascadedModel", "guide": None}


def test_groups_dimensions_units_and_values_are_those_of_the_windows(cascade: CheckContext, tmp_path: Path) -> None:
    write_samples(cascade, tmp_path / "samples.nc", ABOUT, windows=14, samples=30)
    data = arviz().from_netcdf(tmp_path / "samples.nc")
    assert set(data.groups()) == {
        *("posterior", "prior", "posterior_predictive", "prior_predictive"),
        *("observed_data", "sample_stats", "constant_data"),
    }
    assert dict(data.posterior["effect_code"].sizes) == {"chain": 1, "draw": 30, "window": 14, "effect_dimension": 4}
    centers = data.posterior_predictive["next_centers"]
    assert centers.dims == ("chain", "draw", "window", "push", "object", "axis")
    assert (centers.attrs["units"], list(centers["axis"].values)) == ("metres", ["x", "y", "z"])
    assert list(centers["push"].values) == [1, 2, 3]
    assert data.observed_data["actions"].dims == ("window", "push", "parameter")
    assert data.attrs["model"] == "CascadedModel" and "guide" not in data.attrs
    # Windows are in an order of their own; padding is NaN.
    mask, actions = cascade.validation.states.mask.numpy(), cascade.validation.actions.numpy()
    order, wanted = (np.argsort(one[:, 0, 0]) for one in (data.observed_data["actions"].values, actions))
    assert np.array_equal(data.observed_data["actions"].values[order], actions[wanted])
    goals = data.observed_data["subgoal_centers"].values[order]
    assert np.array_equal(np.isnan(goals[..., 0]), ~mask[:, -1][wanted])
    predicted = data.prior_predictive["next_centers"].values[0][:, order]
    assert np.array_equal(np.isnan(predicted[..., 0]).all((0, 2)), ~mask[:, 0][wanted])
    assert np.isfinite(data.sample_stats["log_weight"].values).all()


def test_posterior_predictions_follow_the_codes_of_the_posterior(cascade: CheckContext) -> None:
    """Actions lie around g's mean for the exported codes, as far as their likelihood says."""
    groups = sample_groups(cascade, windows=14, samples=200)
    codes = groups["posterior"]["motion_code"]
    assert codes.shape == (1, 200, 14, 4) and not torch.equal(codes, groups["prior"]["motion_code"])
    model = cascade.model
    order = torch.randperm(14, generator=torch.Generator().manual_seed(cascade.seed))  # as `some_windows` has it
    means = model.actions(
        cascade.validation.first.scene(order).expand((200, 14)),
        effect_code=groups["posterior"]["effect_code"][0],
        motion_code=codes[0],
    )
    residuals = groups["posterior_predictive"]["actions"][0] - means
    starts, motions = residuals[..., :2].std(), residuals[..., 2:].std()
    assert float(starts) == pytest.approx(0.077, rel=0.05) and float(motions) == pytest.approx(0.245, rel=0.05)


def test_a_bad_file_is_one_line_and_nothing_is_left_of_one_that_cannot_be_written(
    cascade: CheckContext, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert check_export(None) is None
    with pytest.raises(UserError, match=r"^export=samples.json must name a netCDF file: give it the ending .nc$"):
        check_export("samples.json")
    (tmp_path / "file").touch()
    with pytest.raises(FileExistsError):
        check_export(str(tmp_path / "file" / "samples.nc"))

    def full(*arguments: Any, **options: Any) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(arviz().InferenceData, "to_netcdf", full)
    with pytest.raises(OSError, match="No space left"):
        write_samples(cascade, tmp_path / "samples.nc", ABOUT, windows=2, samples=2)
    assert [path.name for path in tmp_path.iterdir()] == ["file"]
