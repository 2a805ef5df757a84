"""The default folder for a run's results: different configurations have different folders."""

from __future__ import annotations

import hashlib
import json
from typing import Any

from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.composition import preset_defaults, search_path
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import flat_options

# The folder of a run without overrides, and the options that never decide which folder it is: runs that differ only in
# these are the same run.
LAUNCH = ("workers", "launcher", "address")
FOLDERS = {
    "collect": ("data/pushes", ("transitions", "repair", *LAUNCH)),
    "pretrain": ("runs/pretrain", ()),
    "train": ("runs/train", ()),
    "check": ("runs/check", ("sections",)),
    "calibrate": ("runs/calibrate", ()),
    "plan": ("runs/plan/{task}-{reward}-{objects}-{planner}-{seed}", ("video", "viewer")),
    "evaluate": ("runs/evaluate/{task}-{reward}-{objects}-{planner}-{seed}", ("episodes", "compare", "merge", *LAUNCH)),
    "demo": ("runs/demo", ()),
    "reproduce": ("runs/reproduce/{scale}", ("workers",)),
}


def with_output(name: str, config: DictConfig, hydra_config: Any) -> DictConfig:
    """The configuration with `output`; in a sweep (`-m`) every run has a folder of its own, in `output` if it is given.

    Args:
        hydra_config: of the same composition.

    Raises:
        UserError: `output` is empty.
    """
    if config.output == "":
        raise UserError("output must name a folder, not '': leave it for the usual one")
    pattern, _ = FOLDERS[name]
    sweep = hydra_config.mode == RunMode.MULTIRUN
    if config.output is not None and not sweep:
        return config
    run = run_name(name, config, hydra_config)
    folder = f"{pattern.partition('/{')[0]}{'/' if '{' in pattern else ''}{run}"
    if sweep:
        folder = f"{config.output or f'runs/{name}/multirun'}/{run.strip('-') or 'defaults'}"
    return OmegaConf.merge(config, {"output": folder})  # type: ignore[return-value]


def run_name(name: str, config: DictConfig, hydra_config: Any) -> str:
    """A name that identifies a run of a command: presets by name, other differences by their hash."""
    pattern, irrelevant = FOLDERS[name]
    # A folder of the user's own presets (--config-dir) is on the search path, which the composition here lacks.
    own = [one.path for one in hydra_config.runtime.config_sources if one.schema == "file"]
    search = [search_path(*own)] if own else []
    defaults, usual = preset_defaults(name, [*hydra_config.overrides.task, *search])
    choices = {str(group): choice for group, choice in hydra_config.runtime.choices.items()}
    values: dict[str, Any] = {**{str(key): value for key, value in config.items()}, **choices}
    template = pattern.partition("/")[2].partition("/")[2] if "{" in pattern else ""
    named = template.format(**values)
    changed = [
        str(choice)
        for group, choice in choices.items()
        if choice != usual.get(group) and not group.startswith("hydra") and f"{{{group}}}" not in pattern
    ]
    before, now = (flat_options(OmegaConf.to_container(one, resolve=True)) for one in (defaults, config))
    told = {key for key in now if f"{{{key}}}" in pattern} | {"output", *irrelevant}
    other = {key: now.get(key) for key in {*now, *before} - told if now.get(key, {}) != before.get(key, {})}
    digest = hashlib.sha256(json.dumps(other, sort_keys=True).encode()).hexdigest()[:6]
    return "".join([named, *(f"-{choice}" for choice in changed), f"-{digest}" if other else ""])
