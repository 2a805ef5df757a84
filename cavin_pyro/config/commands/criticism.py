"""Options of the commands check and calibrate."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

from cavin_pyro.config.commands.device import DeviceOptions
from cavin_pyro.config.commands.episodes import CHECKPOINTS, DEFAULT_CHECKPOINT
from cavin_pyro.config.commands.training import DATA
from cavin_pyro.config.commands.world import WorldConfig, collection_world
from cavin_pyro.config.options import option, seed_option


@dataclass
class CheckConfig:
    """Options of `python -m cavin_pyro.check`."""

    defaults: list[Any] = field(
        default_factory=lambda: ["_self_", {"sizes": "default"}, {"env/ranges": "paper"}, "base"]
    )
    checkpoint: str = option(
        DEFAULT_CHECKPOINT,
        f"checkpoint to check: a shipped one ({', '.join(CHECKPOINTS)}), or the path of one from train",
    )
    a: str | None = option(None, "first of two checkpoints to compare, in place of checkpoint")
    b: str | None = option(
        None, "second checkpoint to compare; both are checked on windows that neither was trained on"
    )
    trust: list[str] = option([], "modules of your own whose classes the checkpoint may name")
    data: Any = option("data/pushes", f"{DATA}; preferably the model's training data")
    output: str | None = option(
        None, "folder for the report, in which an unfinished check resumes; by default runs/check, or beside it"
    )
    seed: int = seed_option()
    windows: int = option(1000, "held-out windows, and as many training windows", minimum=1)
    sections: Any = option(None, "sections of the report, [elbo,subgoals]; by default all")
    export: str | None = option(None, "file.nc for samples of prior, guide and predictions, which ArviZ reads")
    sizes: Any = None
    env: WorldConfig = field(default_factory=collection_world)


CALIBRATED = ("guide", "scales")


@dataclass
class CalibrateConfig(DeviceOptions):
    """Options of `python -m cavin_pyro.calibrate`."""

    defaults: list[Any] = field(default_factory=lambda: ["_self_", "base"])
    checkpoint: str = option(
        DEFAULT_CHECKPOINT,
        f"checkpoint to calibrate: a shipped one ({', '.join(CHECKPOINTS)}), or the path of one from train",
    )
    trust: list[str] = option([], "modules of your own whose classes the checkpoint may name")
    parts: list[str] = option(
        ["guide"], f"what to calibrate, {' or '.join(CALIBRATED)}: parts=[guide,scales] does both"
    )
    data: Any = option("data/pushes", f"{DATA}; the model's training data")
    output: str | None = option(None, "folder for the checkpoint; by default runs/calibrate, or beside it")
    seed: int = seed_option()
    steps: int = option(1500, "gradient steps", minimum=1)
    batch_size: int = option(256, "windows per step", minimum=1)
    learning_rate: float = option(3e-3, "learning rate of Adam at the start; it falls to a hundredth of that", above=0)
    wake_weight: float = option(
        0.03,
        "weight of -ELBO on real windows beside the loss on generated ones; 0 learns from generated ones alone",
        minimum=0,
    )
    windows: int = option(2000, "held-out windows for measurements", minimum=1)
    samples: int = option(50, "samples of the guide for each window, in measurements", minimum=2)
