"""Run directories: each holds its configuration, so that a run can be repeated and resumed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from omegaconf import DictConfig, OmegaConf

from cavin_pyro.config.errors import UserError, user_input
from cavin_pyro.config.options import flat_options, shown
from cavin_pyro.storage.files import CONFIG_NAME, DATA_NAME, atomic_write, holds_no_result, read_json, write_json


def write_config(folder: Path, config: DictConfig) -> dict[str, Any]:
    """Write `config.yaml` and return the configuration as plain data."""
    plain: Any = OmegaConf.to_container(config, resolve=True)
    with atomic_write(folder / CONFIG_NAME) as temporary:
        temporary.write_text(OmegaConf.to_yaml(config, resolve=True), encoding="utf-8")
    return plain


def check_same_run(folder: Path, config: DictConfig, *, ignore: tuple[str, ...]) -> None:
    """Check that the run in a folder, if there is one, has this configuration.

    `ignore`: options that may differ, as `section.name`. A `UserError` names the first other one that does.
    """
    path = folder / CONFIG_NAME
    if not path.exists() and any((folder / name).exists() for name in ("episodes.jsonl", "resume.safetensors")):
        raise UserError(f"{folder} holds results, and no {CONFIG_NAME} says of what: choose another output=DIR")
    if not path.exists() or holds_no_result(folder):
        return  # there is nothing to protect
    with user_input(where=f"{path} is damaged, choose another output=DIR"):
        earlier = stored_options(path)
    now = flat_options(OmegaConf.to_container(config, resolve=True))
    for name in sorted(set(now) | set(earlier)):
        if name not in ignore and now.get(name) != earlier.get(name):
            raise UserError(
                f"{folder} holds a run with {name}={shown(earlier.get(name))}, not {shown(now.get(name))}: "
                "resume it with its own command and options, or choose another output=DIR"
            )


def stored_options(path: Path) -> dict[str, Any]:
    """The options in a `config.yaml` by their dotted names."""
    return flat_options(OmegaConf.to_container(OmegaConf.load(path)))


def check_same_data(folder: Path, data: Sequence[Mapping[str, Any]]) -> None:
    """Check that a run resumes with the data that it began with, in any folder; the first time, record them.

    `data`: of each dataset, among other things, its number of `transitions` and the `fingerprint` of its content.
    """
    path = folder / DATA_NAME
    now = [{name: dataset[name] for name in ("transitions", "fingerprint")} for dataset in data]
    if not path.exists() or holds_no_result(folder):
        write_json(path, now)
    elif (earlier := read_json(path)) != now:
        raise UserError(
            f"{folder} holds a run with other data, {earlier} instead of {now}: "
            "resume with the same data=DIR, or choose another output=DIR"
        )
