"""Options: each declared once, with its default, meaning, unit and range, in a dataclass.

@dataclass
class TrainerConfig:
    batch_size: int = option(64, "windows per gradient step", minimum=1)

The command line, `--help`, the library and the documentation all read them there.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Iterator, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from typing import Any, TypeVar, Union, get_args, get_origin, get_type_hints

from hydra.utils import get_object
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cavin_pyro.config.errors import UserError

KINDS = {
    bool: "true or false",
    int: "a whole number",
    float: "a number",
    str: "a name",
    list: "a list",
    tuple: "a list",
    dict: "a section",
}
T = TypeVar("T")
MAXIMUM_SEED = 2**32 - 1  # the largest that all random generators accept


@dataclass(frozen=True)
class About:
    """The declaration of an option, apart from its type and its default.

    Attributes:
        help: one line. unit: of a number. group: the heading under which `--help` lists it.
        choices: names, or the dotted path of a collection of them, which is imported on demand.
        minimum, maximum: both allowed. above: an exclusive lower bound.
        limit: a number beyond it is a slip, which would fill the memory or never end; `--help` does not tell it.
    """

    help: str
    unit: str = ""
    group: str = ""
    choices: Collection[str] | str | None = None
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None
    limit: float | None = None

    @property
    def names(self) -> tuple[str, ...] | None:
        """The choices, None if there is no list of them."""
        return None if self.choices is None else tuple(named(self.choices))


def option(default: Any, help: str, **about: Any) -> Any:
    """A field of a configuration; for `about` see `About`. A list or a dataclass is copied for each configuration."""
    metadata = {"about": About(help, **about)}
    if isinstance(default, list | dict) or is_dataclass(default):
        return field(default_factory=lambda: copy.deepcopy(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def seed_option(help: str = "seed of all random numbers", **about: Any) -> Any:
    """The option `seed`."""
    return option(0, help, minimum=0, maximum=MAXIMUM_SEED, **about)


def named(choices: Collection[str] | str) -> Collection[str]:
    """Choices, or the collection at their dotted path."""
    return get_object(choices) if isinstance(choices, str) else choices


@dataclass(frozen=True)
class Option:
    """An option of the command line: `name` is dotted, `type` its annotation."""

    name: str
    type: Any
    default: Any
    about: About


def options(schema: type, prefix: str = "") -> Iterator[Option]:
    """The options of a configuration, those of its sections among them, in order of declaration."""
    hints = get_type_hints(schema)
    for one in fields(schema):
        about = one.metadata.get("about")
        default = one.default if one.default_factory is MISSING else one.default_factory()
        if is_dataclass(hints[one.name]):
            for inner in options(type(default), f"{prefix}{one.name}."):
                section_default = default
                for part in inner.name.removeprefix(f"{prefix}{one.name}.").split("."):
                    section_default = getattr(section_default, part)
                yield Option(inner.name, inner.type, section_default, inner.about)
        elif about is not None:
            yield Option(f"{prefix}{one.name}", hints[one.name], default, about)


def check_options(schema: type, config: Mapping[str, Any], prefix: str = "") -> None:
    """Check the ranges and choices of a composed configuration with valid types.

    Args:
        prefix: of option names in error lines.

    Raises:
        UserError: an option out of its range, which the message states.
    """
    for one in options(schema):
        value: Any = config
        for part in one.name.split("."):
            value = value[part]
        check_value(f"{prefix}{one.name}", value, one.about, whole=int in (one.type, *get_args(one.type)))


def check_value(name: str, value: Any, about: About, *, whole: bool = False) -> None:
    """Check one value; None, `???` and interpolations are not checked.

    Raises:
        UserError: it is out of its range, or none of the choices.
    """
    if value is None or (isinstance(value, str) and value.startswith(("${", "???"))):
        return
    if isinstance(value, Mapping) and value.get("_target_"):
        return  # a class of the user's, which says itself what is wrong with it
    if about.choices is not None:
        for entry in value if isinstance(value, list) else [value]:
            if entry not in (about.names or ()):
                raise UserError(f"unknown {name} {entry!r}: choose from {', '.join(about.names or ())}")
    elif (about.above is not None and not value > about.above) or (
        about.minimum is not None
        and not about.minimum <= value <= (float("inf") if about.maximum is None else about.maximum)
    ):
        raise UserError(f"{name} must be {_range(about, whole)}, not {shown(value)}")
    elif about.limit is not None and not value <= about.limit:
        unit = f" {about.unit}" if about.unit else ""
        raise UserError(f"{name} must be at most {about.limit:.10g}{unit}, not {shown(value)}")


def shown(value: Any) -> Any:
    """A value in the user's notation."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:g}" if isinstance(value, float) else value if value != "" else "''"


def _range(about: About, whole: bool) -> str:
    unit = f" {about.unit}" if about.unit else ""
    if about.above is not None:
        return "a positive number" if about.above == 0 else f"more than {about.above:g}{unit}"
    if about.maximum is None:
        return f"at least {about.minimum:g}{unit}"
    if whole:
        return f"a whole number from {about.minimum} to {about.maximum}"
    return f"between {about.minimum:g} and {about.maximum:g}{unit}"


def kind(annotation: Any) -> str | None:
    """The name of a type in an error line: "a whole number"; None if it has none."""
    inner = [one for one in get_args(annotation) if one is not type(None)]
    if get_origin(annotation) is Union or type(annotation).__name__ == "UnionType":
        kinds = [kind(one) for one in inner]
        return " or ".join(one for one in kinds if one) if all(kinds) else None
    if is_dataclass(annotation):
        return "a section"
    origin = get_origin(annotation) or annotation
    if isinstance(origin, type) and origin not in KINDS:
        if issubclass(origin, Mapping):
            return KINDS[dict]
        if issubclass(origin, Collection):
            return KINDS[list]
    return KINDS.get(origin) if isinstance(origin, type) else None


def types(schema: type, prefix: str = "") -> dict[str, Any]:
    """The type of every option and section, by its dotted name."""
    found: dict[str, Any] = {}
    for name, annotation in get_type_hints(schema).items():
        found[f"{prefix}{name}"] = annotation
        if is_dataclass(annotation) and isinstance(annotation, type):
            found |= types(annotation, f"{prefix}{name}.")
    return found


def configured(schema: type[T], values: Mapping[str, Any], section: str) -> T:
    """A configuration from a section of a command's or of a stored one, in which options may be missing or unknown.

    Raises:
        UserError: a value of another type, or out of its range.
    """
    known = {str(name): value for name, value in values.items() if name in types(schema)}
    try:
        merged = OmegaConf.merge(OmegaConf.structured(schema), known)
    except OmegaConfBaseException as error:
        raise UserError(f"{section}.{error.full_key} is of another type: {str(error).splitlines()[0]}") from error
    found: Any = OmegaConf.to_object(merged)
    check_options(schema, vars(found), f"{section}.")
    return found


def flat_options(value: Any, prefix: str = "") -> dict[str, Any]:
    """A configuration's values by the dotted names of options: {"a": {"b": 1}} -> {"a.b": 1}."""
    if not isinstance(value, dict):
        return {prefix.rstrip("."): value}
    return {key: one for name, entry in value.items() for key, one in flat_options(entry, f"{prefix}{name}.").items()}
