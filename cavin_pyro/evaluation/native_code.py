"""Whether a planner runs native code, or on a GPU CUDA graphs: the option `planner.compile`."""

from __future__ import annotations

from pathlib import Path

import torch
from omegaconf import DictConfig

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import shown
from cavin_pyro.config.parts import class_of
from cavin_pyro.config.world import task_of
from envs.layouts import GENERATED, RANDOM
from models.model import Model
from models.priors.flow import FlowPrior
from planning.searching import AUTO, GRAPHS, SearchingPlanner


def check_native_code(config: DictConfig) -> None:
    """Refuse unknown values of `planner.compile`, and true with options that keep plans from being compiled.

    Raises:
        UserError: it is one; the choices, or the first such option, are named.
    """
    chosen = config.planner.get("compile", False)
    if not isinstance(chosen, bool) and chosen != AUTO:
        raise UserError(f"planner.compile must be true, false or {AUTO}, not {shown(chosen)}")
    if chosen is True and (why := _obstacle(config)):
        raise UserError(f"planner.compile=true {why}: choose planner.compile=false")


def argument_compile(config: DictConfig, device: torch.device, model: Model, path: Path) -> bool | str:
    """The planner's argument `compile`: the option's value, but false where `auto` could give other plans or nothing,
    and `GRAPHS` on a GPU where there would be native code on the CPU.

    Native code in float32 makes the plans that eager functions make, up to rounding, if both sample noise rather than
    codes, as they do for warm starts. With products of bfloat16 it rounds at other places.

    Args:
        path: of the model's checkpoint.

    Raises:
        UserError: the model is to be compiled, and cannot.
    """
    chosen: bool | str = config.planner.compile
    flows = any(isinstance(part, FlowPrior) for part in model.modules())
    if chosen is True and flows:
        raise UserError(
            f"planner.compile=true, but the priors in {path} are flows, which cannot be compiled: "
            "choose planner.compile=false"
        )
    equal = config.matmul_precision == "float32" and config.planner.get("warm_start") is True
    if chosen == AUTO and (flows or not equal or _obstacle(config)):
        return False
    return GRAPHS if chosen and device.type == "cuda" else chosen


def searches(planner: DictConfig) -> bool:
    """Whether a planner has inner functions to compile."""
    found = class_of(planner)
    return isinstance(found, type) and issubclass(found, SearchingPlanner)


def _obstacle(config: DictConfig) -> str | None:
    """What in the options keeps plans from being compiled, to follow `planner.compile=true`; None if nothing does."""
    if config.layout == RANDOM or (config.layout == GENERATED and config.generated.seed is None):
        return f"compiles for one layout, and layout={config.layout} samples another in every episode"
    if task_of(config)[0].goal_varies:
        return "compiles for one goal, and this task has another in every episode"
    return None
