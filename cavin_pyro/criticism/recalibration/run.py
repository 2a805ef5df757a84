"""A calibration, from its configuration to the checkpoint with the repaired guide or scales."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import torch
from omegaconf import DictConfig

from cavin_pyro.config.commands.criticism import CALIBRATED
from cavin_pyro.config.errors import UserError
from cavin_pyro.criticism.context import CheckContext
from cavin_pyro.criticism.loading import Loaded, context_of, load_trained
from cavin_pyro.criticism.recalibration.measurement import Measured
from cavin_pyro.criticism.recalibration.scales import calibrate_scales, check_scales, measure_scales
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
        UserError: a checkpoint or data that cannot be used, an unknown part, or a model that has none of it.
    """
    path = find_checkpoint(config.checkpoint)
    if unknown := [part for part in config.parts if part not in CALIBRATED]:
        raise UserError(f"parts has no {unknown[0]!r}: choose from {', '.join(CALIBRATED)}")
    if not config.parts:
        raise UserError(f"parts is empty, so that there is nothing to calibrate: choose from {', '.join(CALIBRATED)}")

    def accept(model: Model) -> None:
        if "scales" in config.parts:
            check_scales(model)
        if not model.codes and "guide" in config.parts:
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


def calibrate_f(context: CheckContext, windows: int) -> dict[str, Any]:
    """Widen the scales that f predicts, in place, by half of the held-out episodes; measured on the other half.

    Args:
        windows: held-out ones, at most.

    Returns:
        `factor`, and `before` and `after`, as `measure_scales` has them.

    Raises:
        UserError: fewer than two episodes, or nothing moved.
    """
    window, episodes = context.held_out(windows)
    order = torch.unique(episodes, return_inverse=True)[1]
    fitted, measured = (torch.nonzero(order % 2 == parity).flatten() for parity in (0, 1))
    if len(measured) == 0:
        raise UserError("all held-out windows are of one episode: collect more transitions")
    others = window.map(lambda field: field[measured]), episodes[measured]
    before = measure_scales(context.model, *others)
    factor = calibrate_scales(context.model, window.map(lambda field: field[fitted]))
    return {"factor": factor, "before": before, "after": measure_scales(context.model, *others)}


def write_calibrated(folder: Path, config: DictConfig, loaded: Loaded, measured: Measured) -> Path:
    """Write the checkpoint with guide and f's scales as they are now, and `calibration.json` beside it.

    Its provenance has a record for every calibration in `calibrated`: program, options, the SHA-256 of the file that
    was calibrated (`checkpoint`), fingerprints of the data, and what was `measured`, without `losses`.
    """
    checkpoint, path = loaded.checkpoint, folder / "checkpoint.safetensors"
    parts = {"guide": loaded.guide, "model": loaded.model}
    now = {f"{part}.{name}": value for part, module in parts.items() for name, value in module.state_dict().items()}
    changed = {name: value.detach().contiguous() for name, value in now.items() if name in checkpoint.tensors}
    record = {
        **provenance(),
        "parts": list(config.parts),
        **{name: config[name] for name in OPTIONS},
        "checkpoint": file_digest(loaded.path),
        "data": [one["fingerprint"] for data in loaded.folders for one in content_records(data)],
        **{name: value for name, value in measured.items() if name != "losses"},
    }
    earlier = checkpoint.provenance.get("calibrated")
    about = {**checkpoint.provenance, "calibrated": [*(earlier if isinstance(earlier, list) else []), record]}
    with atomic_write(path) as temporary:
        temporary.write_bytes(checkpoint_bytes({**checkpoint.tensors, **changed}, checkpoint.config, about))
    write_json(folder / "calibration.json", {**record, **measured})
    return path
