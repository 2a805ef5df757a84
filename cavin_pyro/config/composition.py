"""From a command's name and overrides to its configuration, or to one line about the wrong override."""

from __future__ import annotations

import difflib
import functools
import itertools
import re
import shlex
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any, get_args

import hydra
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, OverrideType
from hydra.errors import HydraException, MissingConfigException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException, ValidationError

from cavin_pyro.config.commands import COMMANDS, UNREAD
from cavin_pyro.config.constructors import check_parts, constructor_options
from cavin_pyro.config.errors import UserError
from cavin_pyro.config.options import check_options, kind, shown, types
from cavin_pyro.config.registration import register
from cavin_pyro.config.rewriting import rewritten

register()


def compose(name: str, *overrides: str) -> DictConfig:
    """The configuration of `python -m cavin_pyro.<name> <overrides>`, for callers in Python.

    Raises:
        UserError: an invalid override.
    """
    return completed(name, check_overrides(name, rewritten(overrides)))


def completed(name: str, config: DictConfig) -> DictConfig:
    """What `check_overrides` has composed, without Hydra's own section, resolved, and with an output folder.

    Raises:
        UserError: an option has no value.
    """
    from cavin_pyro.config.output import with_output

    own = OmegaConf.masked_copy(config, [str(key) for key in config if key != "hydra"])
    return with_output(name, resolved(own), config.hydra)


def resolved(config: DictConfig) -> DictConfig:
    """A configuration without interpolations and types, for other processes and files.

    Raises:
        UserError: an option has no value.
    """
    try:
        # Plain, because Hydra's own interpolations mean nothing in a worker process.
        plain = OmegaConf.create(OmegaConf.to_container(config, resolve=True, throw_on_missing=True))
    except OmegaConfBaseException as error:
        raise UserError(f"an option has no value: {str(error).splitlines()[0]}") from error
    assert isinstance(plain, DictConfig)
    return plain


def check_overrides(name: str, overrides: list[str], config_dir: str | None = None) -> DictConfig:
    """Compose, and explain a wrong override in one line.

    Args:
        config_dir: a folder of further presets.

    Returns:
        The configuration with Hydra's own.

    Raises:
        UserError: an unknown command, option or preset, an override that does not parse, or a value out of its range.
    """
    if name not in COMMANDS:
        raise UserError(f"unknown command {name!r}: choose from {', '.join(COMMANDS)}")
    if config_dir is not None:
        overrides = [*overrides, search_path(str(Path(config_dir).resolve()))]
    with _hydra():
        try:
            _check_additions(name, overrides)
            _check_read(name, overrides)
            _check_nulls(name, overrides)
            config = hydra.compose(name, overrides=overrides, return_hydra_config=True)
            plain: Any = OmegaConf.to_container(config, resolve=False)
            check_parts({key: value for key, value in plain.items() if key != "hydra"})
            check_options(COMMANDS[name], plain)
        except MissingConfigException as error:
            raise UserError(_explain_choice(error)) from error
        except (HydraException, OmegaConfBaseException, ValueError) as error:
            raise UserError(_explain_override(name, overrides, error)) from error
    return config


def search_path(*folders: str) -> str:
    """The override that lets presets lie in these folders as well."""
    return f"hydra.searchpath=[{','.join(_in_quotes(f'file://{folder}') for folder in folders)}]"


def sweeps(overrides: Sequence[str]) -> Iterator[list[str]]:
    """The overrides of every run of a sweep (`-m`): all combinations of the values given."""
    parsed = OverridesParser.create().parse_overrides(_parsable(overrides))
    choices = [
        [f"{one.get_key_element()}={value}" for value in one.sweep_string_iterator()]
        if one.is_sweep_override()
        else [one.input_line or ""]
        for one in parsed
    ]
    bad = [[word] for word in overrides if not _parsable([word])]
    yield from (list(one) for one in itertools.product(*choices, *bad))


def preset_defaults(name: str, overrides: Sequence[str]) -> tuple[DictConfig, dict[str, str]]:
    """The configuration with the presets that the overrides choose and nothing else, and the usual presets by group."""
    with _hydra():
        return _defaults(name, overrides), _usual_presets(name)


@contextmanager
def _hydra() -> Iterator[None]:
    """Hydra ready for composition, within a command as well as without one."""
    running, GlobalHydra.instance().hydra = GlobalHydra.instance().hydra, None
    try:
        with hydra.initialize(version_base="1.3", config_path=None):
            yield
    finally:
        GlobalHydra.instance().hydra = running


def _defaults(name: str, overrides: Sequence[str]) -> DictConfig:
    """The configuration with the presets that the user chose and no other overrides."""
    groups = _usual_presets(name)
    chosen = [word for word in overrides if word.partition("=")[0] in groups]
    folders = [word for word in overrides if word.startswith("hydra.searchpath")]  # of users, who may change them
    return hydra.compose(name, overrides=chosen + folders) if folders else _presets(name, tuple(chosen))


@functools.cache  # a composition takes a twentieth of a second
def _presets(name: str, chosen: tuple[str, ...]) -> DictConfig:
    """The configuration with some of our presets, to be read only."""
    return hydra.compose(name, overrides=[*chosen])


@functools.cache  # a composition takes a tenth of a second
def _usual_presets(name: str) -> dict[str, str]:
    """The preset of each group that a command takes when the user names none."""
    choices = hydra.compose(name, return_hydra_config=True).hydra.runtime.choices
    return {str(group): str(choice) for group, choice in choices.items()}


def _check_additions(name: str, overrides: list[str]) -> None:
    """Refuse `~option`, and `+option` unless it belongs to a part, whose class checks it later."""
    changes = [one for one in _parsed(overrides) if one.type is not OverrideType.CHANGE]
    if not changes:
        return
    known = _defaults(name, overrides)
    for one in changes:
        key = one.key_or_group
        if key.startswith("hydra"):
            continue
        if one.type is OverrideType.DEL:
            raise UserError(f"{key} cannot be removed: give it a value as {key}=value")
        parent: Any = OmegaConf.select(known, key.rpartition(".")[0]) if "." in key else None
        if not (OmegaConf.is_dict(parent) and "_target_" in parent) and OmegaConf.select(known, key) is None:
            raise UserError(_unknown(key, known))


def _check_read(name: str, overrides: list[str]) -> None:
    """Refuse options that only other commands read."""
    for one in _parsed(overrides):
        option = re.split(r"[./@]", one.key_or_group)[0]
        if option in UNREAD.get(name, {}):
            readers = (other for other, schema in COMMANDS.items() if option in types(schema) and other != name)
            raise UserError(f"{one.key_or_group} is an option of {' and '.join(readers)}: {UNREAD[name][option]}")


def _check_nulls(name: str, overrides: list[str]) -> None:
    """Refuse `None`, a name like any other to Hydra, for options that may be null."""
    written = [one.key_or_group for one in _parsed(overrides) if (one.input_line or "").endswith("=None")]
    if not written:
        return
    known = _defaults(name, overrides)
    for key in written:
        section, _, last = key.rpartition(".")
        part: Any = OmegaConf.select(known, section) if section else None
        target = part.get("_target_") if OmegaConf.is_dict(part) else None
        own = constructor_options(target).get(last) if target else None
        annotation = own.annotation if own else types(COMMANDS[name]).get(key)
        if type(None) in get_args(annotation):
            raise UserError(f"{key} may be null, which the command line does not write None: write {key}=null")


def _explain_choice(error: MissingConfigException) -> str:
    group, _, choice = (error.missing_cfg_file or "").rpartition("/")
    options = ", ".join(error.options or ()) or "none"
    own = f"; a class of your own is {group.replace('/', '.')}._target_={choice}" if "." in choice else ""
    return f"unknown {group or 'configuration'} {choice!r}: choose from {options}{own}"


def _explain_override(name: str, overrides: list[str], error: Exception) -> str:
    try:
        known = _defaults(name, overrides)
    except (HydraException, OmegaConfBaseException, ValueError):
        known = hydra.compose(name)
    for override in _parsed(overrides):
        key = override.key_or_group
        if (
            override.package
            or key.startswith("hydra")
            or override.type is not OverrideType.CHANGE
            or set("@/") & set(key)
        ):
            continue
        parent, _, last = key.rpartition(".")
        if not last.startswith("_") and last not in _names(known, parent):
            own = [one for one in _parsed(overrides) if one.key_or_group == f"{parent}._target_"]
            hint = f"; for an argument of {own[0].value()} write +{override.input_line}" if own else ""
            return _unknown(key, known) + hint
    cause = error.__cause__ or error
    if isinstance(cause, ValidationError) and cause.full_key:
        option = re.sub(r"\[.*", "", str(cause.full_key))
        wanted = kind(types(COMMANDS[name]).get(option))
        values = [one.value() for one in _parsed(overrides) if one.key_or_group == option]
        if wanted and values:
            return f"{option} must be {wanted}, not {shown(values[-1])}"
    if isinstance(error, OverrideParseException) and (quoted := _quoted(error.override)):
        return f"{error.override} holds a character that needs quotes: write {quoted}"
    first = str(error).splitlines()[0].rstrip(".").removeprefix("LexerNoViableAltException: ")
    several = re.match(r"Ambiguous value for argument '(.+)'$", first)
    if several:
        return f"several values need -m: python -m cavin_pyro.{name} -m {several[1]}"
    group = re.match(r"Could not override '(\w+)/(\w+)'. No match in the defaults list", first)
    if group:
        return f"unknown override '{group[1]}.{group[2]}': the chosen {group[1]} has no {group[2]}"
    return f"{first}: write overrides as name=value"


_ENTRY = r"[^][{},:\"']*[^][{},:\"'\x00-\x7F][^][{},:\"']*"  # of a list, with a character that is not ASCII


def _in_quotes(value: str | re.Match[str]) -> str:
    text = value if isinstance(value, str) else value[0]
    return '"' + text.replace('"', '\\"') + '"'


def _quoted(override: str) -> str | None:
    """An override that does not parse, for the shell and with its value in quotes; None if that does not help.

    Unquoted values may hold ASCII letters, digits, spaces and some signs (Hydra's grammar).
    """
    key, equals, value = override.partition("=")
    if not equals:
        return None
    if value.startswith(("[", "{", "'", '"')):
        quoted = f"{key}={re.sub(_ENTRY, _in_quotes, value)}"
    else:
        quoted = f"{key}={_in_quotes(value)}"
    return shlex.quote(quoted) if _parsable([quoted]) else None


def _unknown(key: str, known: DictConfig) -> str:
    parent, _, last = key.rpartition(".")
    close = difflib.get_close_matches(last, _names(known, parent), n=1, cutoff=0.7)
    while parent and not _names(known, parent):
        parent = parent.rpartition(".")[0]
    valid = f"valid{' under ' if parent else ''}{parent} are {', '.join(_names(known, parent))}"
    others = [name for name, schema in COMMANDS.items() if key in types(schema)]
    elsewhere = f"it is an option of {', '.join(others)}; " if others else ""
    return f"unknown override {key!r}: {elsewhere}{f'did you mean {close[0]}? ' if close else ''}{valid}"


def _parsed(overrides: Sequence[str]) -> list[Override]:
    return OverridesParser.create().parse_overrides(_parsable(overrides))


def _parsable(overrides: Sequence[str]) -> list[str]:
    kept = []
    for word in overrides:
        try:
            OverridesParser.create().parse_override(word)
        except HydraException:
            continue
        kept.append(word)
    return kept


def _names(known: DictConfig, section: str) -> list[str]:
    """The options of a section, none if there is no such section."""
    found: Any = OmegaConf.select(known, section) if section else known
    return sorted(map(str, found)) if OmegaConf.is_dict(found) else []
