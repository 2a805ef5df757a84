"""The options of every command, each declared once: type, default, meaning, unit and range."""

from __future__ import annotations

from cavin_pyro.config.commands.collection import CollectConfig
from cavin_pyro.config.commands.criticism import CalibrateConfig, CheckConfig
from cavin_pyro.config.commands.episodes import DemoConfig, EvaluateConfig, PlanConfig
from cavin_pyro.config.commands.reproduction import ReproduceConfig
from cavin_pyro.config.commands.training import PretrainConfig, TrainConfig

COMMANDS: dict[str, type] = {
    "collect": CollectConfig,
    "pretrain": PretrainConfig,
    "train": TrainConfig,
    "check": CheckConfig,
    "calibrate": CalibrateConfig,
    "plan": PlanConfig,
    "evaluate": EvaluateConfig,
    "demo": DemoConfig,
    "reproduce": ReproduceConfig,
}
