"""The model of a checkpoint."""

from __future__ import annotations

from pathlib import Path

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.parts import build_model
from cavin_pyro.models.model import Model
from cavin_pyro.storage.checkpoint import Checkpoint


def model_of(checkpoint: Checkpoint, where: str | Path) -> Model:
    """The model program with its trained parameters, in evaluation mode and without gradients.

    Args:
        where: names the checkpoint in messages.

    Raises:
        UserError: there is no model in it, or one of another architecture.
    """
    if "model" not in checkpoint.config:
        raise UserError(f"checkpoint {where} holds no model: give one that train has written")
    model = build_model(checkpoint.config)
    checkpoint.load_into("model", model, where)
    return model.requires_grad_(False).eval()
