"""A run's folder: the configuration that made it, so that it can be read, repeated and resumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from cavin_pyro.errors import UserError
from cavin_pyro.files import read_json, replacing, write_json


def write_config(folder: Path, config: DictConfig) -> dict[str, Any]:
    """Write `config.yaml` and return the configuration as plain data."""
    plain = OmegaConf.to_container(config, resolve=True)
    assert isinstance(plain, dict)
    with replacing(folder / "config.yaml") as temporary:
        temporary.write_text(OmegaConf.to_yaml(config, resolve=True), encoding="utf-8")
    return {str(name): value for name, value in plain.items()}


def check_same_run(folder: Path, config: DictConfig, *, ignore: tuple[str, ...]) -> None:
    """Make sure that a folder with an earlier run in it may be resumed with this configuration.

    Args:
        ignore: words (dotted) that may differ.

    Raises:
        UserError: the earlier run had another configuration; the first word that differs is named.
    """
    path = folder / "config.yaml"
    if not path.exists():
        return
    try:
        earlier = flat_words(OmegaConf.to_container(OmegaConf.load(path)))
    except (OSError, OmegaConfBaseException, yaml.YAMLError, ValueError) as error:
        raise UserError(f"{path} is damaged ({' '.join(str(error).split())}): choose another output=DIR") from error
    now = flat_words(OmegaConf.to_container(config, resolve=True))
    for name in sorted(set(now) | set(earlier)):
        if name not in ignore and now.get(name) != earlier.get(name):
            raise UserError(
                f"{folder} holds a run with {name}={earlier.get(name)}, not {now.get(name)}: "
                "resume with the same words, or choose another output=DIR"
            )


def check_same_data(folder: Path, data: Sequence[Mapping[str, Any]]) -> None:
    """Make sure that a run goes on with the data that it began with, wherever they lie now; the first time, note them.

    Args:
        data: of each dataset its number of `transitions` and the `mark` of its contents, among other things.

    Raises:
        UserError: the run in this folder began with other data, or what it noted of them cannot be read.
    """
    path = folder / "data.json"
    now = [{name: dataset[name] for name in ("transitions", "mark")} for dataset in data]
    if not path.exists():
        write_json(path, now)
    elif (earlier := read_json(path)) != now:
        raise UserError(
            f"{folder} holds a run with other data, {_of_transitions(earlier)} instead of {_of_transitions(now)}: "
            "resume with the same data=DIR, or choose another output=DIR"
        )


def _of_transitions(data: Any) -> str:
    """What `data.json` holds, in words."""
    try:
        return " and ".join(f"{dataset['transitions']} transitions ({dataset['mark']})" for dataset in data)
    except (TypeError, KeyError):
        return "something unreadable"


def flat_words(value: Any, prefix: str = "") -> dict[str, Any]:
    """A configuration's values by their words: {"a": {"b": 1}} -> {"a.b": 1}."""
    if not isinstance(value, dict):
        return {prefix.rstrip("."): value}
    flat: dict[str, Any] = {}
    for name, entry in value.items():
        flat |= flat_words(entry, f"{prefix}{name}.")
    return flat
