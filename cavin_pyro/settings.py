"""From the words of `train`, and what other commands share with it, to checked settings."""

from __future__ import annotations

from pathlib import Path

from omegaconf import DictConfig

from cavin_pyro.arithmetic import PRODUCTS
from cavin_pyro.errors import UserError, at_least, check_seed, fraction, one_of
from cavin_pyro.training import BATCHES, SCHEDULES, TrainerSettings
from cavin_pyro.windows import WindowSettings


def data_folders(config: DictConfig) -> list[Path]:
    """The word `data`: a folder, or a list of them."""
    return [Path(folder) for folder in ([config.data] if isinstance(config.data, str) else config.data)]


def trainer_settings(config: DictConfig) -> TrainerSettings:
    """The section `trainer`.

    Raises:
        UserError: a number out of range or an unknown schedule.
    """
    trainer = config.trainer
    for name in ("steps", "batch_size", "validate_every", "validation_windows", "patience"):
        at_least(f"trainer.{name}", trainer[name], 1)
    check_seed(config.seed)
    for name in ("learning_rate", "clip_norm"):
        if not isinstance(trainer[name], int | float) or not trainer[name] > 0:
            raise UserError(f"trainer.{name} must be a positive number, not {trainer[name]}")
    for name, choices in (("schedule", SCHEDULES), ("batches", BATCHES), ("products", PRODUCTS)):
        one_of(f"trainer.{name}", trainer[name], choices)
    return TrainerSettings(**{str(name): value for name, value in trainer.items()}, seed=config.seed)


def window_settings(config: DictConfig) -> WindowSettings:
    """The section `windows`, for the model's T.

    Raises:
        UserError: a number out of range.
    """
    windows = config.windows
    for name in ("validation_fraction", "quiet_fraction"):
        fraction(f"windows.{name}", windows[name])
    for name in ("maximum_step", "minimum_move", "maximum_move"):
        at_least(f"windows.{name}", windows[name], 0)
    at_least("model.segment_length", config.model.segment_length, 1)
    sizes = {str(name): value for name, value in windows.items()}
    sizes["without"] = tuple(sizes.get("without", ()))  # older checkpoints do not tell
    return WindowSettings(segment_length=config.model.segment_length, seed=config.seed, **sizes)
