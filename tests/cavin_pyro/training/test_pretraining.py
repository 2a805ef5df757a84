from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from safetensors import safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor

from cavin_pyro.config.errors import UserError
from cavin_pyro.models.networks.pointnet import PointNet, PointNetAutoencoder
from cavin_pyro.training import pretraining
from cavin_pyro.training.pretraining import _augment, pretrain
from cavin_pyro.training.resume import write_resume


def clouds(count: int = 60) -> NDArray[np.float32]:
    """Points on boxes of different sides, in metres from the centre."""
    generator = np.random.default_rng(0)
    sides = generator.uniform(0.02, 0.1, size=(count, 1, 3))
    return (sides * generator.uniform(-1, 1, size=(count, 64, 3))).astype(np.float32)


def pretrained(
    folder: Path,
    *,
    steps: int = 60,
    rate: float = 3e-3,
    points: NDArray[np.float32] | None = None,
) -> tuple[PointNet, dict[str, float]]:
    folder.mkdir(exist_ok=True)
    torch.manual_seed(0)
    autoencoder = PointNetAutoencoder(feature_dimension=16, width=32, points=32)
    options = {"steps": steps, "batch_size": 16, "learning_rate": rate, "seed": 0, "log": folder / "metrics.csv"}
    options["resume"] = folder / "resume.safetensors"
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
    assert not (tmp_path / "metrics.csv").exists()


def weights(part: torch.nn.Module) -> Tensor:
    return torch.nn.utils.parameters_to_vector(part.parameters())


def test_interrupted_pretraining_resumes_as_if_it_had_not_been_interrupted(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, losses = pretrained(tmp_path / "whole", steps=20)
    written = []

    def interrupted(path: Path, *state: Any) -> None:
        write_resume(path, *state)
        written.append(path)
        if len(written) in (7, 12):
            raise KeyboardInterrupt

    monkeypatch.setattr(pretraining, "write_resume", interrupted)
    for _ in range(2):
        with pytest.raises(KeyboardInterrupt):
            pretrained(tmp_path / "broken", steps=20)
    again, its_losses = pretrained(tmp_path / "broken", steps=20)
    assert len(written) == 20  # none of the steps was made twice
    assert torch.equal(weights(again), weights(whole)) and its_losses == losses
    metrics = [(tmp_path / name / "metrics.csv").read_text() for name in ("whole", "broken")]
    assert metrics[0] == metrics[1]


def test_pretraining_goes_on_with_its_own_clouds_and_whole_files_only(tmp_path: Path) -> None:
    path = tmp_path / "resume.safetensors"
    pretrained(tmp_path, steps=3)
    good = path.read_bytes()
    with pytest.raises(UserError, match=r"is damaged: delete it to start again, .*: it was made with other clouds$"):
        pretrained(tmp_path, steps=3, points=clouds() * 2)
    with safe_open(path, framework="pt") as file:
        header, tensors = file.metadata(), load_file(path)
    state = json.loads(header["state"])
    for changes in ({"rows": []}, {"rows": [[1, 2, 3]]}, {"step": "x"}, {"generator": {}}, {"rate": None}):
        save_file(tensors, path, metadata={**header, "state": json.dumps({**state, **changes})})
        with pytest.raises(UserError, match=r"resume\.safetensors is damaged"):
            pretrained(tmp_path, steps=3)
    for content in (good[:-4], b"", good[: len(good) // 2]):
        path.write_bytes(content)
        with pytest.raises(UserError, match=r"resume\.safetensors is damaged"):
            pretrained(tmp_path, steps=3)
