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
from typing import Any, TypeVar, get_type_hints

from hydra.utils import get_object
from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cavin_pyro.config.errors import UserError

T = TypeVar("T")
MAXIMUM_SEED = 2**32 - 1  # the largest that all random generators accept


@dataclass(frozen=True)
class About:
    """The declaration of an option, apart from its type and its default.

    Attributes:
        help: one line. unit: of a number.
        choices: names, or the dotted path of a collection of them, which is imported on demand.
        minimum, maximum: both allowed. above: an exclusive lower bound.
    """

    help: str
    unit: str = ""
    choices: Collection[str] | str | None = None
    minimum: float | None = None
    maximum: float | None = None
    above: float | None = None

    @property
    def names(self) -> tuple[str, ...] | None:
        """The choices, None if there is no list of them."""
        choices = get_object(self.choices) if isinstance(self.choices, str) else self.choices
        return None if choices is None else tuple(choices)

    @property
    def range(self) -> str:
        """The numbers that are allowed, in words."""
        unit = f" {self.unit}" if self.unit else ""
        if self.above is not None:
            return "a positive number" if self.above == 0 else f"more than {self.above:g}{unit}"
        if self.maximum is None:
            return f"at least {self.minimum:g}{unit}"
        return f"between {self.minimum:.10g} and {self.maximum:.10g}{unit}"


def option(default: Any, help: str, **about: Any) -> Any:
    """A field of a configuration; for `about` see `About`. A list or a dataclass is copied for each configuration."""
    metadata = {"about": About(help, **about)}
    if isinstance(default, list | dict) or is_dataclass(default):
        return field(default_factory=lambda: copy.deepcopy(default), metadata=metadata)
    return field(default=default, metadata=metadata)


def seed_option(help: str = "seed of all random numbers", default: int = 0) -> Any:
    """The option `seed`."""
    return option(default, help, minimum=0, maximum=MAXIMUM_SEED)


@dataclass(frozen=True)
class Option:
    """An option of the command line: `name` is dotted."""

    name: str
    default: Any
    about: About


def options(schema: Any, prefix: str = "") -> Iterator[Option]:
    """The options of a configuration class or of an instance, those of its sections among them, as declared."""
    hints = get_type_hints(schema if isinstance(schema, type) else type(schema))
    for one in fields(schema):
        default = one.default if one.default_factory is MISSING else one.default_factory()
        default = default if isinstance(schema, type) else getattr(schema, one.name)
        if is_dataclass(hints[one.name]):
            yield from options(default, f"{prefix}{one.name}.")
        elif "about" in one.metadata:
            yield Option(f"{prefix}{one.name}", default, one.metadata["about"])


def check_options(schema: type, config: Mapping[str, Any], prefix: str = "") -> None:
    """Check the ranges and choices of a resolved configuration with valid types.

    Args:
        prefix: of option names in error lines.

    Raises:
        UserError: an option out of its range, or none of the choices; the message states them.
    """
    for one in options(schema):
        value: Any = config
        for part in one.name.split("."):
            value = value[part]
        if value is not None:
            check_value(f"{prefix}{one.name}", value, one.about)


def check_value(name: str, value: Any, about: About) -> None:
    """Check one value.

    Raises:
        UserError: it is out of its range, or none of the choices.
    """
    if isinstance(value, Mapping) and value.get("_target_"):
        return  # a class of the user's, which says itself what is wrong with it
    if about.choices is not None:
        for entry in value if isinstance(value, list) else [value]:
            if entry not in (about.names or ()):
                raise UserError(f"unknown {name} {entry!r}: choose from {', '.join(about.names or ())}")
        return
    low = -float("inf") if about.minimum is None else about.minimum
    high = float("inf") if about.maximum is None else about.maximum
    bounded = about.above is not None or about.minimum is not None
    if bounded and not (low <= value <= high and (about.above is None or about.above < value < float("inf"))):
        raise UserError(f"{name} must be {about.range}, not {shown(value)}")


def shown(value: Any) -> Any:
    """A value in the user's notation."""
    if isinstance(value, bool) or value is None:
        return {True: "true", False: "false", None: "null"}[value]
    return f"{value:g}" if isinstance(value, float) else value if value != "" else "''"


def configured(schema: type[T], values: Mapping[str, Any], section: str) -> T:
    """A configuration from a section of a command's or of a stored one, in which options may be missing or unknown.

    Raises:
        UserError: a value of another type, or out of its range.
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
