from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from cavin_pyro.config.errors import UserError
from cavin_pyro.training.pretraining import _augment, _rate_after, pretrain
from models.networks.pointnet import PointNet, PointNetAutoencoder


def clouds(count: int = 60) -> NDArray[np.float32]:
    """Points on boxes of different sides, in metres from the centre."""
    generator = np.random.default_rng(0)
    sides = generator.uniform(0.02, 0.1, size=(count, 1, 3))
    return (sides * generator.uniform(-1, 1, size=(count, 64, 3))).astype(np.float32)


def pretrained(
    folder: Path,
    *,
    seed: int = 0,
    steps: int = 60,
    rate: float = 3e-3,
    resume: Path | None = None,
    points: NDArray[np.float32] | None = None,
) -> tuple[PointNet, dict[str, float]]:
    torch.manual_seed(0)
    autoencoder = PointNetAutoencoder(feature_dimension=16, width=32, points=32)
    log = folder / "metrics.csv"
    options = {"steps": steps, "batch_size": 16, "learning_rate": rate, "seed": seed, "log": log, "resume": resume}
    losses = pretrain(autoencoder, clouds() if points is None else points, **options)
    return autoencoder.encoder, losses


def test_reconstructions_become_better_than_one_average_shape(tmp_path: Path) -> None:
    encoder, losses = pretrained(tmp_path, steps=150)
    with open(tmp_path / "metrics.csv", newline="") as file:
        rows = [{name: float(value) for name, value in row.items()} for row in csv.DictReader(file)]
    assert losses["validation"] < 0.9 * losses["mean_shape"]
    assert losses["validation"] == rows[-1]["validation"] < 0.8 * rows[0]["validation"]
    assert [row["step"] for row in rows] == [3 * number for number in range(1, 51)]
    with torch.no_grad():
        features = encoder(torch.from_numpy(clouds(10)))
    assert (features[0] - features[1:]).norm(dim=-1).min() > 1e-3  # shapes are told apart


def test_equal_seeds_pretrain_equal_features(tmp_path: Path) -> None:
    weights = [
        torch.nn.utils.parameters_to_vector(pretrained(tmp_path, seed=seed, steps=5)[0].parameters())
        for seed in (0, 0, 1)
    ]
    assert torch.equal(weights[0], weights[1])
    assert not torch.equal(weights[0], weights[2])


@pytest.mark.parametrize("steps", [1, 2, 7, 60])
def test_the_learning_rate_is_that_of_torchs_cosine_to_the_last_bit(steps: int) -> None:
    optimizer = torch.optim.Adam([torch.nn.Parameter(torch.zeros(1))], lr=3e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    rate = 3e-3
    for step in range(1, steps + 1):
        assert rate == optimizer.param_groups[0]["lr"]
        optimizer.step()
        schedule.step()
        rate = _rate_after(step, rate, steps)
    assert rate == schedule.get_last_lr()[0] == pytest.approx(0.0, abs=1e-18)


def test_training_clouds_are_turned_about_the_vertical_and_scaled_a_little() -> None:
    before = clouds(40)
    after = _augment(before, np.random.default_rng(0)).numpy()
    assert after.dtype == np.float32
    scale = after[..., 2] / before[..., 2]
    np.testing.assert_allclose(scale, scale[:, :1].repeat(64, axis=1), rtol=1e-3)
    assert 0.8 <= scale.min() < 0.9 < 1.1 < scale.max() <= 1.2501
    radius = [np.linalg.norm(points[..., :2], axis=-1) for points in (before, after)]
    np.testing.assert_allclose(radius[1], scale[:, :1] * radius[0], rtol=1e-3)
    angle = np.angle((after[..., 0] + 1j * after[..., 1]) / (before[..., 0] + 1j * before[..., 1]))[:, 0]
    assert angle.min() < -2 and angle.max() > 2


def test_a_loss_that_is_not_finite_stops_pretraining(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="the loss is not finite: lower learning_rate"):
        pretrained(tmp_path, rate=1e30)
    assert not list(tmp_path.iterdir())
