"""Pretraining PointNet by reconstructing clouds (paper, section 4.1: "a pretrained PointNet")."""

from __future__ import annotations

import csv
import hashlib
import math
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor

from cavin_pyro.config.device import send
from cavin_pyro.config.errors import UserError
from cavin_pyro.models.networks.pointnet import CLOUD_UNIT, PointNetAutoencoder, chamfer_distance
from cavin_pyro.storage.files import atomic_write
from cavin_pyro.storage.progress import progress_bar
from cavin_pyro.training.resume import load_optimizer, optimizer_tensors, resuming, section, write_resume

CPU = torch.device("cpu")


def pretrain(
    autoencoder: PointNetAutoencoder,
    clouds: NDArray[np.float32],
    *,
    steps: int,
    batch_size: int,
    learning_rate: float,
    seed: int,
    log: Path,
    resume: Path,
    device: torch.device = CPU,
) -> dict[str, float]:
    """Minimise the Chamfer distance between clouds and their reconstructions.

    Training clouds are augmented by rotations about the vertical and small scalings, for shapes and directions that are
    rare in the data; validation clouds (one in ten) are not.

    Args:
        clouds: [N, 256, 3] from their centres. log: where the losses go, as CSV.
        resume: a file that keeps the state at every fiftieth of the steps, from which the same call resumes; the result
            equals that of an unbroken run.
        device: of the steps; the batches are chosen and augmented on the CPU, where the autoencoder is in the end.

    Returns validation losses in units of (0.1 m) squared: `validation`, and `mean_shape`, the loss of one average cloud
    for all. A loss that is not finite, or a damaged resume file, is a `UserError`.
    """
    generator = np.random.default_rng(seed)
    held_out = max(1, len(clouds) // 10)
    validation, training = torch.from_numpy(clouds[:held_out]).to(device), clouds[held_out:]
    autoencoder.to(device)
    optimizer = torch.optim.Adam(autoencoder.parameters(), lr=learning_rate)
    rows: list[tuple[int, float, float]] = []
    begun, running, rate = 0, 0.0, learning_rate
    digest = hashlib.sha256(clouds.tobytes()).hexdigest()
    if resume.exists():
        with resuming(resume) as (tensors, state):
            if state["clouds"] != digest:
                raise ValueError("it was made with other clouds")
            autoencoder.load_state_dict(section(tensors, "autoencoder"))
            load_optimizer(optimizer, tensors)
            generator.bit_generator.state = state["generator"]
            rate = float(state["rate"])
            rows = [(int(step), float(loss), float(validated)) for step, loss, validated in state["rows"]]
            begun = rows[-1][0]
            if begun != state["step"]:
                raise ValueError("its counters contradict one another")
    with progress_bar("pretraining", total=steps, initial=begun) as bar:
        for step in range(begun + 1, steps + 1):
            chosen = generator.integers(len(training), size=min(batch_size, len(training)))
            batch = send(_augment(training[chosen], generator), device)
            optimizer.param_groups[0]["lr"] = rate
            optimizer.zero_grad(set_to_none=True)
            loss = autoencoder.loss(batch)
            if not math.isfinite(loss.item()):
                raise UserError(f"pretraining stopped at step {step}: the loss is not finite: lower learning_rate")
            loss.backward()
            optimizer.step()
            rate = _rate_after(step, rate, steps)
            running += loss.item()
            bar.update()
            if step % max(1, steps // 50) == 0 or step == steps:
                mean = running / max(1, step - (rows[-1][0] if rows else 0))
                rows.append((step, mean, _loss(autoencoder, validation)))
                running = 0.0
                bar.set_postfix(validation=f"{rows[-1][2]:.4f}")
                weights = {f"autoencoder.{name}": value for name, value in autoencoder.state_dict().items()}
                state = {"clouds": digest, "step": step, "rate": rate, "rows": rows}
                state["generator"] = generator.bit_generator.state
                write_resume(resume, {**weights, **optimizer_tensors(optimizer)}, state)
    autoencoder.cpu()
    with atomic_write(log) as temporary, open(temporary, "w", newline="", encoding="utf-8") as file:
        csv.writer(file).writerows([("step", "training", "validation"), *rows])
    return {"validation": rows[-1][2], "mean_shape": _mean_shape_loss(training, validation)}


def _rate_after(step: int, rate: float, steps: int) -> float:
    """The learning rate after so many steps, from that of the last of them: a cosine that ends at 0.

    It is multiplied up from step to step, as torch's `CosineAnnealingLR` does it. The formula of the whole curve
    differs in the last bits, with which pretrained weights would no longer be reproduced exactly.
    """
    return (1 + math.cos(math.pi * step / steps)) / (1 + math.cos(math.pi * (step - 1) / steps)) * rate


def _augment(clouds: NDArray[np.float32], generator: np.random.Generator) -> Tensor:
    turns = Rotation.from_euler("z", generator.uniform(-np.pi, np.pi, size=(len(clouds), 1))).as_matrix()
    scale = generator.uniform(0.8, 1.25, size=(len(clouds), 1, 1))
    return torch.from_numpy((scale * clouds @ turns).astype(np.float32))


@torch.inference_mode()
def _loss(autoencoder: PointNetAutoencoder, clouds: Tensor) -> float:
    losses = [autoencoder.loss(batch).item() * len(batch) for batch in clouds.split(512)]
    return sum(losses) / len(clouds)


@torch.inference_mode()
def _mean_shape_loss(training: NDArray[np.float32], validation: Tensor) -> float:
    pooled = torch.from_numpy(training[:: max(1, len(training) // 64), 0][:64].copy()).to(validation.device)
    distance = chamfer_distance(pooled.expand(len(validation), -1, -1) / CLOUD_UNIT, validation / CLOUD_UNIT)
    return float(distance.mean())
