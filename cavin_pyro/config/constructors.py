"""Options of a class: names, types and defaults from its signature, meanings from its docstring."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields, is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from hydra.utils import get_object

from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import kind, shown

OWN_PACKAGES = ("cavin_pyro", "models", "guides", "planning", "envs")
GIVEN = {  # which `build_model` gives, by group
    "prior": ("dimension", "feature_dimension", "effect_dimension"),
    "geometry": ("feature_dimension",),
    "dynamics": ("feature_dimension", "width"),
}
PLAIN = (bool, int, float, str)
CONTAINERS = (Sequence, Mapping, list, tuple, dict)


def with_defaults(value: Any, group: str = "") -> Any:
    """A preset with all options of our parts: those of the preset, else the constructors' defaults."""
    if isinstance(value, list):
        return [with_defaults(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    own = {name: with_defaults(entry) for name, entry in value.items()}
    target = own.pop("_target_", None)
    if target is None:
        return own if "_target_" not in value else {"_target_": None, **own}
    defaults = {name: one.default for name, one in constructor_options(target).items() if is_shown(one)}
    defaults = {name: part_of(default) for name, default in defaults.items() if name not in GIVEN.get(group, ())}
    return {"_target_": target, **defaults, **own}


def constructor_options(target: str) -> dict[str, inspect.Parameter]:
    """The named arguments of a class of ours or the user's by its dotted path, with types for annotations.

    Empty where there is no such class. They include arguments that a constructor passes on to its parent's.
    """
    try:
        found = get_object(target)
    except Exception:  # a user's module may raise anything; building the part says it in one line
        return {}
    constructors = (
        [vars(one)["__init__"] for one in found.__mro__ if "__init__" in vars(one)]
        if inspect.isclass(found)
        else [found]
    )
    options: dict[str, inspect.Parameter] = {}
    for constructor in constructors:
        if not inspect.isfunction(constructor) or constructor.__module__.partition(".")[0] not in OWN_PACKAGES:
            break
        hints, handed_on = _hints(constructor), False
        for name, one in inspect.signature(constructor).parameters.items():
            handed_on |= one.kind is inspect.Parameter.VAR_KEYWORD
            if one.kind in (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY) and name != "self":
                options.setdefault(name, one.replace(annotation=hints.get(name, Any)))
        if not handed_on:
            break
    return options


def is_shown(one: inspect.Parameter) -> bool:
    """Whether an argument is an option: it has a default that can be written down, or may be left out."""
    if one.default is inspect.Parameter.empty:
        return False
    if one.default is None:
        inner = [part for part in get_args(one.annotation) if part is not type(None)]
        origins = [get_origin(part) or part for part in inner]
        return bool(origins) and all(
            part in PLAIN or part in (Sequence, Mapping, list, tuple, dict) for part in origins
        )
    return isinstance(one.default, (*PLAIN, tuple, list, dict)) or is_dataclass(one.default)


def part_of(default: Any) -> Any:
    """A default as configuration: a dataclass becomes a part of its own."""
    if is_dataclass(default):
        module, name = type(default).__module__, type(default).__name__
        package = module.partition(".")[0]
        if getattr(importlib.import_module(package), name, None) is type(default):
            module = package  # the shorter path, for users
        return {
            "_target_": f"{module}.{name}",
            **{one.name: part_of(getattr(default, one.name)) for one in fields(default)},
        }
    return list(default) if isinstance(default, tuple) else default


def check_parts(config: Mapping[str, Any], prefix: str = "") -> None:
    """Check that the options of every part of a composed configuration are of the types that its class declares.

    Raises:
        UserError: one is not.
    """
    for name, value, one in _declared(config):
        inner = [part for part in get_args(one.annotation) if part is not type(None)] or [one.annotation]
        # The class has better messages for its lists and mappings.
        checked = len(inner) == 1 and (inner[0] in PLAIN or is_dataclass(inner[0]))
        optional = value is None and (one.default is None or type(None) in get_args(one.annotation))
        if not checked or optional or (isinstance(value, str) and value.startswith("${")):
            continue
        accepted = (int, float) if inner[0] is float else (inner[0] if inner[0] in PLAIN else Mapping,)
        if not isinstance(value, accepted) or (isinstance(value, bool) and bool not in accepted):
            raise UserError(f"{prefix}{name} must be {kind(inner[0])}, not {shown(value)}")
    for name, value in config.items():
        if isinstance(value, Mapping):
            check_parts(value, f"{prefix}{name}.")


def _declared(config: Mapping[str, Any]) -> Iterator[tuple[str, Any, inspect.Parameter]]:
    target = config.get("_target_")
    if isinstance(target, str) and target.partition(".")[0] in OWN_PACKAGES:
        for name, one in constructor_options(target).items():
            if name in config:
                yield name, config[name], one


def _hints(constructor: Any) -> dict[str, Any]:
    try:
        return get_type_hints(constructor)
    except NameError:  # of a type that is imported for checkers only
        plain = {one.__name__: one for one in PLAIN}
        return {name: plain[text] for name, text in constructor.__annotations__.items() if text in plain}
