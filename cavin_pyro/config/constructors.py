"""Options of a class: names, types and defaults from its signature."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from types import UnionType
from typing import Any, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import BooleanNode, FloatNode, IntegerNode, StringNode, ValueNode

OWN_PACKAGES = ("cavin_pyro", "models", "guides", "planning", "envs")
GIVEN = {  # which `build_model` gives, by group
    "prior": ("dimension", "feature_dimension", "effect_dimension"),
    "geometry": ("feature_dimension",),
    "dynamics": ("feature_dimension", "width"),
}
NODES: dict[Any, Callable[..., ValueNode]] = {bool: BooleanNode, int: IntegerNode, float: FloatNode, str: StringNode}
CONTAINERS = (Sequence, Mapping, list, tuple, dict)


def with_defaults(value: Any, group: str = "") -> Any:
    """A preset with all options of our parts: those of the preset, else the constructors' defaults.

    They are nodes of OmegaConf that take values of the constructor's types alone.
    """
    if isinstance(value, list):
        return [with_defaults(entry) for entry in value]
    if not isinstance(value, dict):
        return value
    own = {name: with_defaults(entry) for name, entry in value.items()}
    declared = constructor_options(own["_target_"]) if own.get("_target_") else {}
    options = {"_target_": own.pop("_target_")} if "_target_" in own else {}
    for name, one in declared.items():
        if name in own or (is_shown(one) and name not in GIVEN.get(group, ())):
            option = own.pop(name) if name in own else _part_of(one.default)
            options[name] = _node_of(option, one.annotation)
    return options | own


def constructor_options(target: str) -> dict[str, inspect.Parameter]:
    """The named arguments of a class of ours or the user's by its dotted path, with types for annotations.

    Empty where there is no such class. They include arguments that a constructor passes on to its parent's.
    """
    try:
        found = get_object(target)
    except Exception:  # a user's module may raise anything; building the part says it in one line
        return {}
    constructors = [found]
    if inspect.isclass(found):
        constructors = [vars(one)["__init__"] for one in found.__mro__ if "__init__" in vars(one)]
    options: dict[str, inspect.Parameter] = {}
    for constructor in constructors:
        if not inspect.isfunction(constructor) or constructor.__module__.partition(".")[0] not in OWN_PACKAGES:
            break
        hints, parameters = _hints(constructor), inspect.signature(constructor).parameters.values()
        for one in parameters:
            if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY) and one.name != "self":
                options.setdefault(one.name, one.replace(annotation=hints.get(one.name, Any)))
        if not any(one.kind is one.VAR_KEYWORD for one in parameters):
            break
    return options


def is_shown(one: inspect.Parameter) -> bool:
    """Whether an argument is an option: it has a default that can be written down, or may be left out."""
    if one.default is None:
        inner = [get_origin(part) or part for part in get_args(one.annotation) if part is not type(None)]
        return bool(inner) and all(part in NODES or part in CONTAINERS for part in inner)
    return isinstance(one.default, (*NODES, tuple, list, dict)) or (
        one.default is not one.empty and is_dataclass(one.default)
    )


def _part_of(default: Any) -> Any:
    """A default as configuration: a dataclass becomes a part of its own."""
    if is_dataclass(default):
        module, name = type(default).__module__, type(default).__name__
        package = module.partition(".")[0]
        if getattr(importlib.import_module(package), name, None) is type(default):
            module = package  # the shorter path, for users
        values = {one.name: getattr(default, one.name) for one in fields(default)}
        return with_defaults({"_target_": f"{module}.{name}", **values})
    return list(default) if isinstance(default, tuple) else default


def _node_of(value: Any, annotation: Any) -> Any:
    """A value that may be replaced by those of its type; other types than plain ones are left to the class."""
    union = get_origin(annotation) in (Union, UnionType)
    inner = [part for part in get_args(annotation) if part is not type(None)] if union else [annotation]
    if len(inner) != 1 or inner[0] not in NODES:
        return value
    return NODES[inner[0]](value, is_optional=value is None or (union and type(None) in get_args(annotation)))


def _hints(constructor: Any) -> dict[str, Any]:
    try:
        return get_type_hints(constructor)
    except NameError:  # of a type that is imported for checkers only
        plain = {one.__name__: one for one in NODES}
        return {name: plain[text] for name, text in constructor.__annotations__.items() if text in plain}
