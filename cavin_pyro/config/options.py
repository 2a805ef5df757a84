"""Options: each declared once, with its default, meaning, unit and range, in a dataclass.

@dataclass
class TrainerConfig:
    batch_size: int = option(64, "windows per gradient step", minimum=1)

The command line, `--help`, the library and the documentation all read them there. Those of a preset's class come from
the signature of its constructor.
"""

from __future__ import annotations

import inspect
import math
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from types import UnionType
from typing import Any, NamedTuple, TypeVar, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import BooleanNode, DictConfig, FloatNode, IntegerNode, ListConfig, OmegaConf, StringNode, ValueNode
from omegaconf.errors import OmegaConfBaseException

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.models.checks import check_number, parameters_of

T = TypeVar("T")
MAXIMUM_SEED = 2**32 - 1  # the largest that all random generators accept
GIVEN = {  # which `build_model` or `make_planner` gives, by group
    "planner": ("decimals", "action_dimension"),
    "prior": ("space", "dimension", "feature_dimension", "effect_dimension"),
    "geometry": ("feature_dimension",),
    "dynamics": ("space", "feature_dimension", "width"),
    "model": ("space",),
    "scales": ("space",),
}
NODES: dict[Any, Callable[..., ValueNode]] = {bool: BooleanNode, int: IntegerNode, float: FloatNode, str: StringNode}
CONTAINERS = (Sequence, Mapping, list, tuple, dict)


@dataclass(frozen=True)
class About:
    """The declaration of an option, apart from its type and its default.

    Attributes:
        help: one line. unit: of a number.
        choices: names, or the dotted path of a collection of them, which is imported on demand.
        minimum, maximum: both allowed, of a number; without any, no check. positive: more than 0, below 1e30.
    """

    help: str
    unit: str = ""
    choices: Collection[str] | str | None = None
    minimum: float | None = None
    maximum: float | None = None
    positive: bool = False

    @property
    def names(self) -> tuple[str, ...] | None:
        """The choices, None if there is no list of them."""
        choices = get_object(self.choices) if isinstance(self.choices, str) else self.choices
        return None if choices is None else tuple(map(str, choices))


def option(default: Any, help: str, **about: Any) -> Any:
    """A field of a configuration; for `about` see `About`. A list is copied for each configuration."""
    metadata = {"about": About(help, **about)}
    if isinstance(default, list):
        return field(default_factory=default.copy, metadata=metadata)
    return field(default=default, metadata=metadata)


def seed_option(help: str = "seed of all random numbers", default: int = 0) -> Any:
    """The option `seed`."""
    return option(default, help, minimum=0, maximum=MAXIMUM_SEED)


def preset_defaults(presets: str) -> Any:
    """Hydra's `defaults` of a command, with the preset of each group, as users type them: "model=flat guide=flat"."""
    chosen = [{group: name} for group, _, name in (word.partition("=") for word in presets.split())]
    return field(default_factory=lambda: ["_self_", *chosen, "base"])


class Option(NamedTuple):
    """An option of the command line: `name` is dotted."""

    name: str
    default: Any
    about: About
    kind: Any


def options(schema: Any, prefix: str = "") -> Iterator[Option]:
    """The options of a configuration class or of an instance, those of its sections among them, as declared."""
    hints = get_type_hints(schema if isinstance(schema, type) else type(schema))
    for one in fields(schema):
        default = one.default if one.default_factory is MISSING else one.default_factory()
        default = default if isinstance(schema, type) else getattr(schema, one.name)
        if is_dataclass(hints[one.name]):
            yield from options(default, f"{prefix}{one.name}.")
        elif "about" in one.metadata:
            yield Option(f"{prefix}{one.name}", default, one.metadata["about"], hints[one.name])


def check_options(schema: type, config: Mapping[str, Any], prefix: str = "") -> None:
    """Check all values of a resolved configuration with valid types by `check_value`; `prefix`: of their names."""
    for one in options(schema):
        value: Any = config
        for part in one.name.split("."):
            value = value[part]
        if isinstance(value, list) and one.kind is not Any and any(isinstance(entry, list | dict) for entry in value):
            raise UserError(f"{prefix}{one.name} must be a plain list such as [a,b], not {value}")
        if value is not None or (one.kind is Any and one.about.choices):
            check_value(f"{prefix}{one.name}", value, one.about, listed=one.kind is not Any)


def check_value(name: str, value: Any, about: About, *, listed: bool = True) -> None:
    """Raise a `UserError` for a value that is out of its range, or none of the choices; the line states them.

    `listed`: whether it may be a list of choices.
    """
    if isinstance(value, Mapping) and value.get("_target_"):
        return  # a class of the user's, which says itself what is wrong with it
    if about.choices is not None:
        if value == []:
            raise UserError(f"{name} must name at least one: choose from {', '.join(about.names or ())}")
        for entry in value if isinstance(value, list) and listed else [value]:
            if str(entry) not in (about.names or ()):
                raise UserError(f"unknown {name} {entry!r}: choose from {', '.join(about.names or ())}")
        return
    if about.minimum is None and not about.positive:
        return
    most = 1e30 if about.positive else math.inf  # torch counts in float32
    span = about.minimum or 0, about.maximum or most
    with user_input():
        place = f"{name} in {about.unit}" if about.unit else name
        check_number(place, value, *span, whole=isinstance(value, int), positive=about.positive)


def shown(value: Any) -> str:
    """A value in the user's notation."""
    if isinstance(value, list | ListConfig):
        return f"[{','.join(map(shown, value))}]"
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:.10g}" if isinstance(value, float) else str(value) if value != "" else "''"


def configured(schema: type[T], values: Mapping[str, Any], section: str) -> T:
    """A configuration from a section of a command's or of a stored one, in which options may be missing or unknown.

    A value of another type, or out of its range, is a `UserError`.
    """
    known = {str(name): value for name, value in values.items() if name in {one.name for one in fields(schema)}}  # type: ignore[arg-type]
    try:
        found: Any = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), known))
    except OmegaConfBaseException as error:
        raise UserError(f"{section}.{error.full_key}: {str(error).splitlines()[0]}") from error
    check_options(schema, vars(found), f"{section}.")
    return found


def flat_options(value: Any, prefix: str = "") -> dict[str, Any]:
    """A configuration's values by the dotted names of options: {"a": {"b": 1}} -> {"a.b": 1}."""
    if not isinstance(value, dict):
        return {prefix.rstrip("."): value}
    return {key: one for name, entry in value.items() for key, one in flat_options(entry, f"{prefix}{name}.").items()}


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
    options = {"_target_": _node_of(own.pop("_target_"), str)} if "_target_" in own else {}
    for name, one in declared.items():
        if name in own or (is_shown(one) and name not in GIVEN.get(group, ())):
            option = own.pop(name) if name in own else _part_of(one.default)
            options[name] = _node_of(option, one.annotation)
    return options | {name: _node_of(option, type(option)) for name, option in own.items()}


def constructor_options(target: str) -> dict[str, inspect.Parameter]:
    """The named arguments of a class of ours or the user's by its dotted path, with types for annotations.

    Empty where there is no such class. They include arguments that a constructor passes on to its parent's.
    """
    try:
        found = get_object(target)
    except (Exception, SystemExit):  # a user's module may raise anything; building the part says it in one line
        return {}
    return parameters_of(found, "cavin_pyro.")


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
        values = {one.name: getattr(default, one.name) for one in fields(default)}
        return with_defaults({"_target_": f"{type(default).__module__}.{type(default).__name__}", **values})
    return list(default) if isinstance(default, tuple) else default


def _node_of(value: Any, annotation: Any) -> Any:
    """A value that may be replaced by those of its type; other types than plain ones are left to the class."""
    if isinstance(value, dict):  # a part, whose place nothing but another part, or null, can take
        return DictConfig(value, ref_type=dict[str, Any], element_type=Any, key_type=str)
    union = get_origin(annotation) in (Union, UnionType)
    inner = [part for part in get_args(annotation) if part is not type(None)] if union else [annotation]
    if len(inner) != 1 or inner[0] not in NODES:
        return value
    return NODES[inner[0]](value, is_optional=value is None or (union and type(None) in get_args(annotation)))
