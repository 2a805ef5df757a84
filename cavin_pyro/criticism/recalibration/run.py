"""A calibration, from its configuration to the checkpoint with the repaired guide."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.loading import Loaded, context_of, load_trained
from cavin_pyro.criticism.recalibration.measurement import Measured
from cavin_pyro.criticism.recalibration.sleep import sleep
from cavin_pyro.data.collection import CollectionConfig
from cavin_pyro.data.dataset import content_records
from cavin_pyro.storage.checkpoint import checkpoint_bytes, find_checkpoint
from cavin_pyro.storage.files import atomic_write, file_digest, write_json
from cavin_pyro.storage.provenance import provenance
from cavin_pyro.training.run import place
from cavin_pyro.training.trainer import unchecked_programs
from models.model import Model
from models.state import Window

CPU = torch.device("cpu")
OPTIONS = ("steps", "batch_size", "learning_rate", "wake_weight", "seed", "device")


def load_calibration(config: DictConfig) -> tuple[Loaded, CheckContext]:
    """The checkpoint with its data, and held-out windows for measurements.

    Raises:
        UserError: a checkpoint or data that cannot be used, or a model without codes.
    """
    path = find_checkpoint(config.checkpoint)

    def accept(model: Model) -> None:
        if not model.codes:
            raise UserError(
                f"checkpoint {path} has model {type(model).__name__}, which has no codes, so that there is no guide to "
                "calibrate"
            )

    loaded = load_trained(config, config.checkpoint, accept)
    context, _ = context_of(config, loaded, CollectionConfig(), loaded.table.validation)
    return loaded, context


def calibrate_guide(config: DictConfig, loaded: Loaded, device: torch.device = CPU) -> list[dict[str, float]]:
    """Fit the guide in place on the windows that its training saw, on a device; returns the losses.

    Model and guide are on the CPU before and after.
    """
    place(loaded.table, device)
    loaded.model.to(device), loaded.guide.to(device)
    generator = torch.Generator().manual_seed(config.seed)
    torch.manual_seed(config.seed)

    def batch() -> Window:
        return loaded.table.batch(loaded.table.sample(config.batch_size, generator, bucketed=True))

    with unchecked_programs():
        losses = sleep(
            loaded.model,
            loaded.guide,
            batch,
            steps=config.steps,
            learning_rate=config.learning_rate,
            wake_weight=config.wake_weight,
        )
    loaded.model.to(CPU), loaded.guide.to(CPU)
    return losses


def write_calibrated(
    folder: Path, config: DictConfig, loaded: Loaded, *, before: Measured, after: Measured, losses: list[dict[str, Any]]
) -> Path:
    """Write the checkpoint with the guide as it is now, all else as it was, and `calibration.json` beside it.

    Its provenance has a record for every calibration in `calibrated`: program, options, the SHA-256 of the file that
    was calibrated (`checkpoint`), fingerprints of the data, and what was measured before and after.
    """
    checkpoint, path = loaded.checkpoint, folder / "checkpoint.safetensors"
    guide = {f"guide.{name}": value.detach().contiguous() for name, value in loaded.guide.state_dict().items()}
    record = {
        **provenance(),
        **{name: config[name] for name in OPTIONS},
        "checkpoint": file_digest(loaded.path),
        "data": [one["fingerprint"] for data in loaded.folders for one in content_records(data)],
        "before": before,
        "after": after,
    }
    earlier = checkpoint.provenance.get("calibrated")
    about = {**checkpoint.provenance, "calibrated": [*(earlier if isinstance(earlier, list) else []), record]}
    with atomic_write(path) as temporary:
        temporary.write_bytes(checkpoint_bytes({**checkpoint.tensors, **guide}, checkpoint.config, about))
    write_json(folder / "calibration.json", {**record, "losses": losses})
    return path
