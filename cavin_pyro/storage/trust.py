"""Which classes a checkpoint may name: this program's, and those of modules that the user trusts."""

from __future__ import annotations

import importlib
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from cavin_pyro.config.errors import UserError, one_line

OWN_MODULES = ("cavin_pyro.models", "cavin_pyro.guides")
OLDER_NAMES = ("models.", "guides.", "planning.", "envs.")  # of packages that had a top-level name before 0.2.0
AUTOMATIC_GUIDES = "pyro.infer.autoguide"  # what guides/automatic.py holds; building one runs the model at most
NEVER_SUGGESTED = {"cavin_pyro", *sys.stdlib_module_names}
ANY = "cavin_pyro.models.model.Model"  # for sections that name no class
LARGEST_SIZE = 4096  # of a number in a configuration that is not compared with the weights
DEEPEST = 20  # levels of a configuration; ours have four


def check_targets(config: Any, path: Path, trust: Sequence[str], depth: int = 0) -> None:
    """Check the sections of a stored configuration from which parts are built; older names of classes become today's.

    A class of a module that is neither ours nor in `trust`, anything else than a class, or an interpolation is a
    `UserError`: `${...}` can read the environment and make up sections that no check has seen.
    """
    if depth > DEEPEST:
        raise UserError(f"checkpoint {path} has a damaged header (its configuration is over {DEEPEST} levels deep)")
    if isinstance(config, str) and "${" in config:
        raise UserError(f"checkpoint {path} has an interpolation in its configuration, which is refused: {config[:80]}")
    if isinstance(config, dict):
        if "_target_" in config:
            if str(config["_target_"]).startswith(OLDER_NAMES):
                config["_target_"] = f"cavin_pyro.{config['_target_']}"
            _check_target(config["_target_"], path, trust)
        if hydras := {"_args_", "_recursive_", "_convert_"} & set(config):
            raise UserError(f"checkpoint {path} has {min(hydras)} in its configuration, which is refused")
        config = [*config, *config.values()]
    for entry in config if isinstance(config, list) else ():
        check_targets(entry, path, trust, depth + 1)


def check_numbers(config: Any, path: Path, largest: int, place: str = "") -> None:
    """Refuse a number of a class of ours far above the weights' largest dimension: the layer would fill the memory."""
    if isinstance(config, dict) and _is_class_of(str(config.get("_target_", ANY)), OWN_MODULES):
        for name, value in config.items():
            check_numbers(value, path, largest, f"{place}{name}.")
    elif isinstance(config, list):
        for value in config:
            check_numbers(value, path, largest, place)
    elif isinstance(config, int) and config > max(LARGEST_SIZE, largest):
        raise UserError(
            f"checkpoint {path} is of another architecture: {place.rstrip('.')}={config}, but no layer in it has more "
            f"than {largest} units"
        )


def _check_target(target: Any, path: Path, trust: Sequence[str]) -> None:
    if target is None or _is_class_of(str(target), (*OWN_MODULES, AUTOMATIC_GUIDES)):
        return
    top = str(target).split(".")[0]
    trusted = [module for module in trust if str(target).startswith(f"{module}.")]
    if _is_class_of(str(target), trusted):
        return
    line = f"checkpoint {path} asks to run {target}, which is not part of this program"
    if trusted:
        named = f"trust=[{','.join(trusted)}]"
        line += f": {named} allows the classes that are defined there, and {target} is none of them"
    elif top.isidentifier() and top != str(target) and top not in NEVER_SUGGESTED:
        line += f": if you trust that module, pass 'trust=[{top}]'"
    raise UserError(line)


def _is_class_of(target: str, modules: Sequence[str]) -> bool:
    """Whether a dotted name is a class that one of the modules, or a module in it, defines; its imports are not."""
    name = target.rpartition(".")
    if not any(_within(name[0], module) for module in modules):
        return False
    try:
        found = getattr(importlib.import_module(name[0]), name[2], None)
    except ImportError:
        return False
    except (Exception, SystemExit) as error:  # of a module of the user's
        raise UserError(f"trust: module {name[0]} cannot be imported: {one_line(error)}") from error
    return isinstance(found, type) and any(_within(found.__module__, module) for module in modules)


def _within(module: str, package: str) -> bool:
    return module == package or module.startswith(f"{package}.")
